"""Where a search starts, and what a plan leaves for the feedback."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control.motion import MotionLimits, compute_feedback_margin, estimate_feedback_noise
from tau_dyn.control.motion.coordinates import compute_trapezoid
from tau_dyn.simulate import CascadeController, CascadeLaw, Trajectory

sys.path.insert(0, str(Path(__file__).parent))
from planned_robots import block, l1


def test_the_trapezoid_is_a_motion_of_the_program():
    """Between nodes its acceleration is linear and its speed and way follow exactly; it rests at both ends."""
    s, v, a = compute_trapezoid(30)
    assert_allclose([s[0], v[0], a[0], s[-1], v[-1], a[-1]], [0, 0, 0, 1, 0, 0], atol=1e-12)
    assert_allclose(a[1::2], (a[:-1:2] + a[2::2]) / 2, atol=1e-12)
    assert_allclose(np.diff(v[::2]), (a[:-1:2] + a[2::2]) / 60, atol=1e-12)
    assert_allclose(np.diff(s[::2]), v[:-1:2] / 30 + (a[:-1:2] / 3 + a[2::2] / 6) / 900, atol=1e-12)
    assert np.diff(s).min() > 0


@pytest.mark.parametrize("with_inertia", [False, True])
def test_encoder_noise_becomes_the_force_noise_that_a_cascade_makes(with_inertia: bool):
    """The standard deviation of a cascade's forces at rest under white encoder noise is the one predicted."""
    model, sigma, dt = l1(), 5e-6, 1e-3
    law = CascadeLaw.for_model(model) if with_inertia else CascadeLaw.of(50.0, 1e4, na=3)
    q = model.robot.home
    rest = np.zeros((4000, 3))
    still = Trajectory(model.robot.actuated, np.arange(4000) * dt, rest + q, rest, rest, "rest")
    controller, rng, zero = CascadeController(law), np.random.default_rng(5), np.zeros(3)
    controller.reset(still)
    tau = [controller.force(k, k * dt, q, zero, zero, q + sigma * rng.standard_normal(3)) for k in range(4000)]
    assert_allclose(np.std(tau[5:], axis=0), estimate_feedback_noise(law, q[None], sigma, dt), rtol=0.06)


def test_the_margin_leaves_room_for_noise_and_for_what_is_unknown():
    """Planned force with its unknown share, plus four standard deviations of noise, fills the limit exactly."""
    model, q = block(effort=400.0), np.zeros((1, 1))
    law, limits = CascadeLaw.of(50.0, 5e3, na=1), MotionLimits.of(model)
    noise = estimate_feedback_noise(law, q, 5e-6)[0]
    margin = compute_feedback_margin(limits, law, q, 5e-6, unknown=0.1)
    assert_allclose((1 - margin) * 400.0 * 1.1 + 4 * noise, 400.0)
    assert_allclose(compute_feedback_margin(limits, law, q, 0.0, unknown=0.0), 0.0, atol=1e-15)
    with raises_code("invalid_value"):
        compute_feedback_margin(limits, law, q, 1e-3)
    with raises_code("invalid_value", "unknown"):
        compute_feedback_margin(limits, law, q, 0.0, unknown=1.5)
