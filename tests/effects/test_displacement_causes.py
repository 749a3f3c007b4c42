"""Causes between encoder and load: displacements by hand, and the force that they cost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, DisplacementEffect, Motion, Scene
from tau_dyn.effects.presliding import integrate_bristle

T = np.arange(0, 2, 1e-3)


def back_and_forth(**signals: np.ndarray) -> Motion:
    """Return one slide of 20 kg on a sine of 0.2 m at 0.5 Hz."""
    w = np.pi
    q, v, a = 0.2 * np.sin(w * T), 0.2 * w * np.cos(w * T), -0.2 * w**2 * np.sin(w * T)
    extra = {k: x.reshape(-1, 1) for k, x in signals.items()}
    return Motion.of(("x",), q[:, None], v[:, None], a[:, None], t=T, signals={**behind(len(T), 20.0), **extra})


def behind(n: int, mass: float) -> dict[str, np.ndarray]:
    """Return the signals of a mass that slides without friction or weight."""
    return {"inertia": np.full((n, 1, 1), mass), "damping": np.zeros((n, 1)), "weight_gradient": np.zeros((n, 1, 1))}


def after_reversal(x: np.ndarray, v: float) -> Motion:
    """Return one slide at distances (N,) since it reversed."""
    one = np.ones((len(x), 1))
    return Motion.of(("x",), one, v * one, one, signals={"reversal": x[:, None]})


def cause(name: str, **settings: float) -> Any:
    return cast("Any", EFFECTS[name](["x"], ["N"], **cast("Any", settings)))


def test_backlash_swings_by_its_whole_size() -> None:
    """40 um of play: the encoder leads by 20 um on either side, and crosses from one to the other on its first 40 um."""
    x = np.array([0.0, 1e-5, 2e-5, 4e-5, 1e-2])
    motion, backward = after_reversal(x, 1.0), after_reversal(x, -1.0)
    effect = cause("backlash", travel=4e-5)
    assert_allclose(4e-5 * effect.displacement(motion)[:, 0, 0], [-2e-5, -1e-5, 0, 2e-5, 2e-5], atol=1e-12)
    assert_allclose(effect.displacement(backward), -effect.displacement(motion))


def test_hysteresis_swings_over_its_distance() -> None:
    """Z is -1 at a reversal, 0 after 0.69 distances, 0.90 after three; the friction's part is z less its final sign."""
    x = 1e-3 * np.array([0.0, np.log(2), 3.0, 50.0])
    motion = after_reversal(x, 1.0)
    z = np.array([-1, 0, 1 - 2 * np.exp(-3), 1])
    loop = cause("hysteresis", distance=1e-3, displaced=1)
    assert_allclose(loop.displacement(motion)[:, 0, 0], z, atol=1e-12)
    assert loop.parameters.names == ("x.lost_motion",) and loop.parameters["x.lost_motion"].unit == "m"
    bristle = cause("hysteresis", distance=1e-3)
    assert_allclose(bristle.columns(motion)[:, 0, 0], z - 1, atol=1e-12)
    assert not bristle.displacement(motion).any()
    assert bristle.parameters["x.hysteresis"].unit == "N"


def test_hysteresis_followed_step_by_step_agrees_with_the_distance_since_the_reversal() -> None:
    """After a full swing forward, ten small steps back or one large one leave the state that the formula gives."""
    effect = cause("hysteresis", distance=1e-3)
    one = effect.followed(np.array(1.0), np.array(-2e-3))
    z = np.array(1.0)
    for _ in range(10):
        z = effect.followed(z, np.array(-2e-4))
    assert_allclose([z, one], -(1 - 2 * np.exp(-2)), rtol=1e-12)
    assert effect.followed(z, np.array(0.0)) == z


def test_a_bristle_never_gives_more_than_it_got(rng) -> None:
    """From rest, the work put into Coulomb friction with its bristle's part is never negative, however small the loops."""
    effect = cause("hysteresis", distance=1e-3)
    z, work = np.array(0.0), [0.0]
    for dq in rng.choice([-2e-5, 2e-5], 20_000):
        after = effect.followed(z, np.array(dq))
        work.append(work[-1] + 0.5 * float(z + after) * dq)  # sign(v), and z - sign(v) beside it
        z = after
    assert min(work) >= 0 and work[-1] > 1e-3


def test_transmission_error_costs_force_with_the_speed_squared() -> None:
    """10 um of 20 mm period at 0.5 m/s on 20 kg: 20 (2 pi / 0.02)^2 1e-5 0.25 = 4.93 N; a quarter of it at half the speed."""
    effect = cause("transmission_error", period=0.02)
    q = np.linspace(0, 0.02, 201)[:, None]
    inertia = behind(201, 20.0)
    found = [
        effect.columns(Motion.of(("x",), q, np.full_like(q, v), 0 * q, signals=inertia))[:, 0, 0] for v in (0.5, 0.25)
    ]
    assert_allclose([1e-5 * np.max(np.abs(f)) for f in found], [4.9348, 1.2337], rtol=1e-4)


@pytest.mark.parametrize("harmonics", [1, 3])
def test_transmission_error_on_paper_is_the_sampled_derivative(harmonics: int) -> None:
    """The acceleration of the displacement taken by hand and from samples agree, sines and cosines of every harmonic."""
    effect, motion = cause("transmission_error", period=0.1, harmonics=harmonics), back_and_forth()
    sampled = DisplacementEffect.columns(effect, motion)
    assert effect.columns(motion).shape == (len(T), 1, 2 * harmonics)
    scale = np.abs(sampled).max(axis=(0, 1))
    assert_allclose(effect.columns(motion)[20:-20] / scale, sampled[20:-20] / scale, atol=1e-4)


def test_a_wrong_pinion_scales_the_mass() -> None:
    """Positions read 0.1 % too long: the load moves that much less, and 20 kg feel like 19.98 kg; forces alone never tell."""
    effect, motion = cause("pinion_scale"), back_and_forth()
    assert_allclose(effect.displacement(motion)[:, :, 0], motion.q)
    assert_allclose(1e-3 * effect.columns(motion)[20:-20, 0, 0], -0.02 * motion.a[20:-20, 0], atol=1e-6)


def test_a_spring_stays_behind_in_proportion_to_the_force() -> None:
    """100 N on 0.02 um/N leave the load 2 um behind the encoder; its stiffness reads 50 MN/m."""
    force = 100 * np.sin(np.pi * T)
    effect, motion = cause("joint_compliance"), back_and_forth(force=force)
    assert_allclose(2e-8 * effect.displacement(motion)[:, 0, 0], 2e-6 * np.sin(np.pi * T), atol=1e-15)
    assert effect.parameters["x.compliance"].unit == "m/N" and effect.parameters["x.compliance"].lower == 0
    hinge = EFFECTS["joint_compliance"](["j"], ["N m"]).parameters["j.compliance"]
    assert hinge.unit == "rad/(N m)"
    said = effect.describe(effect.parameters.update({"x.compliance": {"value": 2e-8, "stderr": 1e-9}}))
    assert said == "a drive that yields by 20.0 ± 1.0 nm/N, a stiffness of 50.0 ± 2.5 MN/m"


def test_forces_alone_are_not_asked_for_play_and_scale() -> None:
    """Without tool or load side, `backlash` and `pinion_scale` are untestable with the experiment that shows them."""
    signals, ones = frozenset({"inertia", "force", "reversal"}), np.ones(1)
    forces = Scene(("x",), ("N",), -ones, ones, 0.1 * ones, ones, 60, 60, signals)
    direct = replace(forces, signals=signals | {"load_side"})
    for name in ("backlash", "pinion_scale"):
        why = EFFECTS[name].untestable(forces)
        assert why is not None and "measured" in why[1]
        assert EFFECTS[name].untestable(direct) is None
    assert all(s["displaced"] == 0 for s in EFFECTS["hysteresis"].grid(forces, ("x",)))
    assert all(s["displaced"] == 1 for s in EFFECTS["hysteresis"].grid(direct, ("x",)))


def test_a_resonance_is_static_below_and_gone_above_its_frequency() -> None:
    """A force's sine: gain and phase of `w^2 / (w^2 - s^2 + 2 zeta w s)` on paper; a constant force: its deflection."""
    t = np.arange(0, 20, 1e-3)
    for f, zeta in ((0.5, 0.02), (9.0, 0.1), (40.0, 0.1)):
        F = 100 * np.cos(2 * np.pi * f * t)
        motion = Motion.of(("x",), *(np.zeros((3, len(t), 1))), t=t, signals={"rigid_force": F[:, None]})
        d = cause("structural_compliance", frequency=10.0, damping=zeta).displacement(motion)[:, 0, 0]
        ratio = f / 10.0
        truth = 100 * np.exp(2j * np.pi * f * t) / (1 - ratio**2 + 2j * zeta * ratio)
        # a force that goes in straight lines from sample to sample is (w dt)^2 / 12 of its sine short: 0.5 % at 40 Hz
        assert_allclose(d[-4000:], truth.real[-4000:], atol=6e-3 * np.abs(truth[0]))
    still = Motion.of(("x",), *(np.zeros((3, 50, 1))), t=t[:50], signals={"rigid_force": np.full((50, 1), 7.0)})
    assert_allclose(cause("structural_compliance").displacement(still)[:, 0, 0], 7.0)


def test_a_stiff_resonance_is_a_spring_without_one() -> None:
    """Far above the motion the swinging load follows as the quasi-static compliance says, friction left to the motor's side."""
    force = {"rigid_force": 30 * np.cos(3 * T), "force": 30 * np.cos(3 * T) + 5}
    motion = back_and_forth(**force)
    stiff = cause("structural_compliance", frequency=200.0, damping=0.1).displacement(motion)
    plain = cause("joint_compliance", friction=0).displacement(motion)
    assert_allclose(stiff[20:], plain[20:], atol=0.02)  # it lags by 2 damping / w, 0.16 ms
    with raises_code("invalid_value", "friction"):
        cause("joint_compliance", friction=2).displacement(motion)


def test_a_bristle_remembers_half_swings(rng) -> None:
    """Along a random path z obeys `dz/dq = (1 - z sign) / distance` step by step, which full swings alone would not show."""
    q = np.cumsum(rng.standard_normal(2000)) * 1e-3
    z = integrate_bristle(q, 4e-3)
    now = z[0]
    for k, dq in enumerate(np.diff(q)):
        now = np.sign(dq) - (np.sign(dq) - now) * np.exp(-abs(dq) / 4e-3)
        assert abs(z[k + 1] - now) < 1e-12
    assert np.abs(integrate_bristle(q, 1e-6)).max() <= 1 + 1e-12 and not integrate_bristle(np.zeros(5), 1.0).any()
