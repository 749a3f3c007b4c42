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


@pytest.mark.parametrize("share", [0.06, 0.2])
def test_friction_that_levels_off_keeps_its_knee(make, rng, share) -> None:
    """A force of 25 N that levels off at a share of the fast speed: the knee, for which a root of the speed also fits well."""
    fast = float(make.bench(rng, motions=(make.moving(rng, ("x",), 6000, size=2.0),)).scene.fast[0])
    effect, null_model = refine(make, rng, lambda v: 25 * v / np.hypot(v, share * fast))
    assert effect.settings["power"] == 0 and find_edge([effect], null_model.channel.scene) == ""
    assert effect.settings["knee"] == pytest.approx(share * fast, rel=0.4)


def test_a_root_of_the_speed_with_a_high_knee_becomes_friction_that_levels_off(make, rng) -> None:
    """At its highest knee a power of 0.5 is followed by power 0, whose highest knee the parabola follows; low knees by none."""
    scene = make.bench(rng).scene
    fast = float(scene.fast[0])

    def find_next(power: float, share: float) -> dict[str, float] | None:
        law = ViscousCurvature(["x"], ["N"], power=power, knee=share * fast).find_limit_law(scene)
        return law and dict(law.settings)

    assert find_next(0.5, 0.1) == {"power": 0.0, "knee": 0.1 * fast}
    assert find_next(0.0, 0.6) == {"power": PARABOLA, "knee": fast}
    assert find_next(0.5, 0.03) is None and find_next(0.0, 0.04) is None and find_next(1.5, 0.1) is None


def test_a_parabola_grows_to_its_knee_and_stays(rng) -> None:
    """Force 10 N at 1 m/s: 7.5 N at half the speed, 10 N beyond, against the motion on both sides."""
    effect = ViscousCurvature(["x"], ["N"], power=PARABOLA, knee=1.0)
    v = np.array([[0.5], [-0.5], [1.0], [3.0]])
    force = effect.force(Motion.of(("x",), 0 * v, v, 0 * v), effect.parameters.with_values(np.array([10.0])))
    np.testing.assert_allclose(force[:, 0], [7.5, -7.5, 10, 10])
    assert effect.refined == () and effect.open_ends == {}
