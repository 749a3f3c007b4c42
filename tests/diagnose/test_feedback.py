"""A controller that answers encoder noise with force: the answer is seen above the motion's band, and no cause is found in it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.encoders import noise_only
from tau_dyn.diagnose.feedback import answered, feedback_taps
from tau_dyn.effects import friction_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Sensors, named_motion, simulate

RATE_HZ = 500.0
PD = np.array([[[-7e4, 1e4], [0.0, -5e4]], [[6e4, 0.0], [0.0, 4e4]]])
"""Taps of two joints [N/m]; the second answers the first's noise as well."""


def moved(rng: np.random.Generator, n: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Return slow positions (n, 2) and encoder noise of 5 um."""
    t = np.arange(n) / RATE_HZ
    q = np.column_stack([0.3 * np.sin(2 * np.pi * 0.7 * t), 0.2 * np.sin(2 * np.pi * 1.1 * t)])
    return q, 5e-6 * rng.standard_normal((n, 2))


def test_taps_come_back_within_their_noise():
    """From the part above 20 Hz alone, behind 0.5 N of noise: each tap within 5 errors of noise over signal."""
    rng = np.random.default_rng(1)
    q, noise = moved(rng)
    residual = answered(PD, noise) + 0.5 * rng.standard_normal(q.shape)
    found = feedback_taps(q + noise, residual, 20.0, RATE_HZ)
    assert found.shape == PD.shape
    assert_allclose(found, PD, atol=5 * 0.5 / (5e-6 * np.sqrt(len(q))))


def test_a_controller_that_sees_the_truth_has_no_taps():
    """Forces that do not know the encoder's noise: no lag earns its freedom."""
    rng = np.random.default_rng(2)
    q, noise = moved(rng)
    assert len(feedback_taps(q + noise, 0.5 * rng.standard_normal(q.shape), 20.0, RATE_HZ)) == 0
    assert len(feedback_taps(q + noise, answered(PD, noise), 200.0, RATE_HZ)) == 0  # nothing is left above the band


def test_logs_made_of_noise_alone_answer_it_as_the_measured_one_did():
    """Taps fitted to the made log are those of the loop, sign and all."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, friction_model("asymmetric", axis.actuated, axis.force_units))
    rng = np.random.default_rng(3)
    t = np.arange(15_000) / RATE_HZ
    w = 2 * np.pi * 0.7
    q, v, a = (x[:, None] for x in (0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t), -0.3 * w**2 * np.sin(w * t)))
    noise, loop = 5e-6 * rng.standard_normal(q.shape), np.array([[[-8e4]], [[6e4]]])
    tau = model.torque(q, v, a) + answered(loop, noise) + 0.2 * rng.standard_normal(q.shape)
    log = Log(t, {"q_axis": (q + noise)[:, 0], "tau_axis": tau[:, 0]}, "loop.csv")
    motion = model.motion(q, v, a, np.sign(v), t=t)
    piece = SimpleNamespace(motion=motion, log=log, preparation=SimpleNamespace(position_cutoff_hz=60.0))
    channel = SimpleNamespace(outputs=axis.actuated, prepared=[piece])
    (made,) = noise_only(cast(Any, channel), model, [20.0], rng)
    force = model.columns(motion) @ model.parameters.values
    taps = feedback_taps(made.joint("q", axis.actuated), made.joint("tau", axis.actuated) - force, 20.0, RATE_HZ)
    assert_allclose(taps, loop, rtol=0.05)


def test_no_cause_is_found_in_a_loop_closed_through_the_encoder():
    """A cascade answers the encoder's noise, with a phase; without its answer counted, it passes for a spring."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, friction_model("asymmetric", axis.actuated, axis.force_units)).with_values(
        {"axis.coulomb_pos": 20.0, "axis.coulomb_neg": 21.0, "axis.viscous_pos": 200.0, "axis.viscous_neg": 190.0}
    )
    sensors = Sensors(encoder_noise=1e-5, force_noise=1.0, log_rate_hz=RATE_HZ)
    log = simulate(model, named_motion("fourier", model, 60.0, 1), sensors=sensors, seed=1)
    found = diagnose(axis, [log])
    assert [f.cause for f in found.findings if f.status == "confirmed"] == []
