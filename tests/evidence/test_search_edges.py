"""A knee beyond the speeds seen, on the bench: viscous friction that bends all the way keeps its name."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.effects import Motion, ViscousCurvature
from tau_dyn.effects.friction import PARABOLA
from tau_dyn.evidence.candidate_scan import N_NULL_DRAWS, scan_causes
from tau_dyn.evidence.settings import estimate_amplitudes, find_edge, refine_settings


def refine(make, rng, law):
    """Return the refined viscous curvature of a bench with a hidden law of speed, and the null_model."""

    def hidden(motion: Motion) -> np.ndarray:
        return law(motion.v)

    channel = make.bench(rng, hidden, motions=(make.moving(rng, ("x",), 6000, size=2.0),), causes=(ViscousCurvature,))
    null_model = make.null_model(channel)
    (best,) = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), (ViscousCurvature,), set())
    return refine_settings(best, null_model).fits[0].effect, null_model


def test_friction_that_bends_up_to_the_top_speed_is_a_parabola(make, rng) -> None:
    """`-20 v |v|` has no knee: the parabola that levels off at the top speed has 20 times its square as amplitude."""
    effect, null_model = refine(make, rng, lambda v: -20 * v * np.abs(v))
    scene = null_model.channel.scene
    assert effect.settings == {"power": PARABOLA, "knee": scene.fast[0]} and find_edge([effect], scene) == ""
    (amplitude,) = estimate_amplitudes(effect, null_model)
    assert amplitude == pytest.approx(20 * scene.fast[0] ** 2, rel=0.15)


def test_friction_with_a_knee_keeps_it(make, rng) -> None:
    """25 arctan(v / 0.1) has its knee within the speeds seen; no parabola takes its place."""
    effect, null_model = refine(make, rng, lambda v: 25 * np.arctan(v / 0.1))
    assert effect.settings["power"] != PARABOLA and effect.settings["knee"] < 0.5 * null_model.channel.scene.fast[0]


def test_a_parabola_grows_to_its_knee_and_stays(rng) -> None:
    """Force 10 N at 1 m/s: 7.5 N at half the speed, 10 N beyond, against the motion on both sides."""
    effect = ViscousCurvature(["x"], ["N"], power=PARABOLA, knee=1.0)
    v = np.array([[0.5], [-0.5], [1.0], [3.0]])
    force = effect.force(Motion.of(("x",), 0 * v, v, 0 * v), effect.parameters.with_values(np.array([10.0])))
    np.testing.assert_allclose(force[:, 0], [7.5, -7.5, 10, 10])
    assert effect.refined == () and effect.open_ends == {}
