"""Causes that act on forces: each law on paper, with numbers by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, Effect, Motion, Scene
from tau_dyn.effects.varying_friction import filter_first_order


def line(q: Any = 0.0, v: Any = 0.0, a: Any = 0.0, t: np.ndarray | None = None, **signals: Any) -> Motion:
    """Return the motion of one slide from scalars or samples."""
    q, v, a = (np.array(np.broadcast_arrays(x, q, v, a)[0], float).reshape(-1, 1) for x in (q, v, a))
    return Motion.of(("x",), q, v, a, t=t, signals={k: np.asarray(s, float).reshape(-1, 1) for k, s in signals.items()})


def cause(name: str, unit: str = "N", **settings: float) -> Effect:
    return EFFECTS[name](["x"], [unit], **cast("Any", settings))


def force(effect: Effect, motion: Motion, **values: float) -> np.ndarray:
    """Return the force (N,) at these values of the joint's parameters."""
    named = {f"x.{k}": x for k, x in values.items()}
    return effect.force(motion, effect.parameters.with_values(named))[:, 0]


def scene(low=-0.5, high=0.5, slow=0.01, fast=1.0, cutoff_hz=60.0, duration=120.0, joints=("x",)) -> Scene:
    n = len(joints)
    lows, highs, slows, fasts = (np.full(n, x) for x in (low, high, slow, fast))
    return Scene(tuple(joints), ("N",) * n, lows, highs, slows, fasts, cutoff_hz, duration)


def test_asymmetry_is_half_the_difference() -> None:
    """92 N forward and 68 N backward are 80 N with an asymmetry of 12 N; 130 and 110 N/(m/s) are 120 with 10."""
    motion = line(v=[0.5, -0.5])
    symmetric = force(cause("symmetric_friction"), motion, coulomb=80, viscous=120)
    total = symmetric + force(cause("coulomb_asymmetry"), motion, coulomb_asymmetry=12)
    total += force(cause("viscous_asymmetry"), motion, viscous_asymmetry=10)
    assert_allclose(total, [92 + 130 * 0.5, -68 - 110 * 0.5])
    both = {"coulomb_pos": 92, "coulomb_neg": 68, "viscous_pos": 130, "viscous_neg": 110}
    assert_allclose(total, force(cause("asymmetric_friction"), motion, **both))


def test_stribeck_peak_has_fallen_to_a_twentieth_at_three_times_its_speed() -> None:
    """12 N at 20 mm/s: 4.415 N at 20 mm/s, 0.597 N at 60 mm/s, against the motion on both sides."""
    motion = line(v=[0.02, -0.06])
    assert_allclose(force(cause("stribeck", speed=0.02), motion, stribeck=12), [4.4146, -0.5974], atol=1e-4)


def test_stribeck_peak_of_the_second_power_is_flat_on_top_and_sooner_gone() -> None:
    """12 N at 20 mm/s: 9.346 N at half that speed (7.278 with the first power), 0.0015 N at three times."""
    motion = line(v=[0.01, -0.06])
    gauss = force(cause("stribeck", speed=0.02, power=2), motion, stribeck=12)
    assert_allclose(gauss, [12 * np.exp(-0.25), -12 * np.exp(-9)], rtol=1e-12)
    with raises_code("invalid_value", "power"):
        cause("stribeck", power=0)


def test_position_friction_is_a_parabola_over_the_range() -> None:
    """P1 = x and P2 = (3 x^2 - 1) / 2 on 0.1 .. 0.5 m; beyond the end the friction stays as at the end."""
    effect = cause("position_friction", middle=0.3, half=0.2, degree=2)
    motion = line(q=[-0.3, 0.1, 0.3, 0.4, 0.5, 0.9], v=[1, 1, 1, -1, 1, 1])
    found = force(effect, motion, position_friction_1=10, position_friction_2=4)
    assert_allclose(found, [-10 + 4, -10 + 4, -2, -(5 - 0.5), 10 + 4, 10 + 4])
    middle = [s["middle"] for s in EFFECTS["position_friction"].grid(scene(0.1, 0.5), ("x",))]
    assert_allclose(middle, 0.3)


def test_position_friction_columns_are_apart_from_coulomb_friction(rng) -> None:
    """On an even visit of the range no combination of columns comes near `sign(v)`: Coulomb friction stays what it is."""
    q = np.linspace(-0.5, 0.5, 2001)
    motion = line(q=q, v=np.where(rng.random(2001) < 0.5, 1.0, -1.0))
    C = cause("position_friction", middle=0.0, half=0.5, degree=5).columns(motion)[:, 0]
    sign = motion.sign[:, 0]
    left = sign - C @ np.linalg.lstsq(C, sign, rcond=None)[0]
    assert left @ left > 0.999 * (sign @ sign)


def test_thermal_drift_follows_a_temperature_step_with_its_lag() -> None:
    """After one lag a step of 10 K has reached 63.2 %, after three 95.0 %; the reference has no drift."""
    t = np.arange(0, 40, 0.01)
    T = np.where(t > 0, 30.0, 20.0)
    warm = filter_first_order(T, t, 10.0)
    assert_allclose(warm[[0, 1000, 3000]], [20, 20 + 10 * (1 - np.exp(-1)), 20 + 10 * (1 - np.exp(-3))], atol=1e-9)
    effect = cause("thermal_drift", lag=10.0, reference=20.0)
    motion = line(v=np.full(len(t), -0.5), t=t, temperature=T)
    found = force(effect, motion, thermal_coulomb=-2.0, thermal_viscous=-1.0)
    assert_allclose(found, (2.0 + 0.5) * (warm - 20), atol=1e-9)
    assert found[-1] > 0  # friction against a backward motion is negative; warm, it is smaller


def test_thermal_drift_without_a_clock_takes_the_temperature_as_it_is() -> None:
    """One sample has no past: 5 K above the reference count at once, whatever the lag."""
    found = force(cause("thermal_drift", lag=30.0), line(v=1.0, temperature=25.0), thermal_coulomb=-2.0)
    assert_allclose(found, [-10.0])


def test_quadratic_drag_quadruples_with_twice_the_speed() -> None:
    """8 N/(m/s)^2: 2 N at 0.5 m/s, -8 N at -1 m/s."""
    assert_allclose(force(cause("quadratic_drag"), line(v=[0.5, -1.0]), quadratic_drag=8), [2, -8])
    assert cause("quadratic_drag").parameters["x.quadratic_drag"].unit == "N/(m/s)^2"


def test_drive_gain_scales_the_whole_force() -> None:
    """A gain error of 3 % on 200 N shows 6 N more."""
    assert_allclose(force(cause("drive_gain"), line(v=[1, 1], force=[200, -100]), gain_error=0.03), [6, -3])


def test_ripple_repeats_after_its_period() -> None:
    """1.8 N of 20.9 mm, with a second harmonic: the same force one period on, and the amplitude is the hypotenuse."""
    effect = cause("cyclic_ripple", period=0.0209, harmonics=2)
    q = np.linspace(0, 0.0209, 400)
    values = {"ripple_sin": 1.08, "ripple_cos": 1.44, "ripple_sin_2": 0.3}
    here, there = (force(effect, line(q=q + k * 0.0209), **values) for k in (0, 7))
    assert_allclose(here, there, atol=1e-10)
    assert_allclose(force(effect, line(q=q), ripple_sin=1.08, ripple_cos=1.44).max(), 1.8, rtol=1e-4)
    parameters = effect.parameters.with_values({f"x.{k}": x for k, x in values.items()})
    parameters = parameters.update({n: {"stderr": 0.2} for n in parameters.names})
    said = effect.describe(parameters)
    assert said == "a force of 1.80 ± 0.20 N that repeats every 20.9 mm, with harmonics of 0.30 ± 0.20 N"


def test_ripple_is_felt_at_speed_over_period() -> None:
    """At 0.2 m/s a 20 mm period passes ten times a second."""
    found = cast("Any", cause("cyclic_ripple", period=0.02)).local_frequency(line(v=[0.2, -0.4]))
    assert_allclose(found[:, 0], [10, 20])


def test_no_period_between_two_tries_is_missed() -> None:
    """Neighbouring periods differ by a quarter turn over the range, from a quarter of the range to 500 turns or the low-pass."""
    grid = EFFECTS["cyclic_ripple"].grid(scene(), ("x",))
    turns = 1 / np.array([s["period"] for s in grid])
    assert_allclose(np.diff(turns), 0.25)
    assert turns[0] == pytest.approx(4) and 499 < turns[-1] < 500
    slow = EFFECTS["cyclic_ripple"].grid(scene(slow=0.1), ("x",))
    assert 1 / slow[-1]["period"] < 60 / (2 * 0.1)
    assert EFFECTS["cyclic_ripple"].grid(scene(low=0.2, high=0.2), ("x",)) == []


def test_delay_is_the_odd_part_of_a_late_force() -> None:
    """A 3 Hz force of 100 N, 1 ms late: the error is the even part left out, 100 N (w delay)^2 / 2 = 0.018 N."""
    t = np.arange(0, 2, 1e-3)
    F = 100 * np.sin(2 * np.pi * 3 * t)
    motion = line(v=np.ones_like(t), t=t, force=F)
    for late in (0.001, -0.001):
        error = F + force(cause("delay", about=late), motion, delay=late) - 100 * np.sin(2 * np.pi * 3 * (t - late))
        assert np.abs(error[5:-5]).max() < 0.019
        assert_allclose(error[5:-5], (F * (2 * np.pi * 3 * late) ** 2 / 2)[5:-5], atol=0.002)  # even: F itself, smaller
    with raises_code("unsupported"):
        cause("delay").columns(line(v=1.0, force=3.0))


def test_one_clock_is_tried_before_single_drives() -> None:
    """All joints share `drive.delay`; a joint alone has a delay of its own; one joint alone is one group."""
    joints = ("a", "b", "c")
    groups = EFFECTS["delay"].groups(scene(joints=joints))
    assert groups == [joints, ("a",), ("b",), ("c",)]
    assert EFFECTS["delay"](joints, ["N"] * 3).parameters.names == ("drive.delay",)
    assert cause("delay").parameters.names == ("x.delay",)
    assert EFFECTS["delay"].groups(scene()) == [("x",)]
    short = EFFECTS["delay"].grid(scene(duration=0.3), ("x",))
    assert max(s["about"] for s in short) == 0.002


def test_friction_of_another_year_counts_in_its_log_alone() -> None:
    """15 N more Coulomb friction in log 2 leaves log 1 alone; with one log there is nothing to compare."""
    motion = line(v=[1, -1, 1, -1], campaign=[0, 0, 1, 1])
    assert_allclose(force(cause("friction_change", number=1), motion, coulomb_change=15), [0, 0, 15, -15])
    cls = EFFECTS["friction_change"]
    one, two, three = (replace(scene(), signals=frozenset({"campaign"}), campaigns=n) for n in (1, 2, 3))
    assert "only one training log" in (cls.untestable(one) or ("",))[0] and cls.untestable(two) is None
    assert [[s["number"] for s in cls.grid(x, ("x",))] for x in (two, three)] == [[1], [0, 1, 2]]


def test_a_shared_motor_has_units_of_its_joints() -> None:
    """Two slides share kg-like inertia in N s^2/m, two hinges N m s^2/rad; only joints of one kind are paired."""
    coupling = EFFECTS["reducer_coupling"]
    assert [p.unit for p in coupling(["a", "b"], ["N", "N"]).parameters] == ["N s^2/m", "N/(m/s)", "N"]
    assert [p.unit for p in coupling(["a", "b"], ["N m", "N m"]).parameters][0] == "N m s^2/rad"
    chain = (("a", "b"), ("b", "c"))
    mixed = replace(scene(joints=("a", "b", "c")), units=("N", "N m", "N m"), coupled=chain)
    assert coupling.groups(mixed) == [("b", "c")]


def test_a_joint_that_stands_still_offers_no_speeds_to_try():
    """Its slowest sure speed is zero, and from zero there is no ladder of speeds a factor apart."""
    assert EFFECTS["stribeck"].grid(scene(slow=0.0), ("x",)) == [] != EFFECTS["stribeck"].grid(scene(slow=0.01), ("x",))
