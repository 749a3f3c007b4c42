"""Which settings of each effect are tried, on which joints, and what is missing where none are."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS, NO_EXPERIMENT, Scene


def scene(joints: str = "xyw", *signals: str, duration: float = 120.0, cutoff_hz: float = 60.0) -> Scene:
    """Return slides x and y and a hinge w: x went from 1 to 1.5 m at 0.01 to 1 m/s, y from 0 to 2 m, w from -1 to 1 rad."""
    about = {"x": ("N", 1.0, 1.5, 0.01, 1.0), "y": ("N", 0.0, 2.0, 0.02, 0.6), "w": ("N m", -1.0, 1.0, 0.05, 3.0)}
    units, *numbers = zip(*(about[joint] for joint in joints), strict=True)
    low, high, slow, fast = (np.array(x) for x in numbers)
    return Scene(
        tuple(joints),
        units,
        low,
        high,
        slow,
        fast,
        cutoff_hz,
        duration,
        frozenset(signals),
        coupled=tuple(pairwise(joints)),
    )


def tried(name: str, joint: str, about: Scene) -> list[dict[str, float]]:
    return EFFECTS[name].grid(about, (joint,))


def test_each_joints_own_way_counts() -> None:
    """Plays of 1e-5, 1e-4 and 1e-3 of it, bristles of a ten-thousandth to a tenth, waves of twice to a quarter."""
    about = scene()
    for joint, way, middle in (("x", 0.5, 1.25), ("y", 2.0, 1.0), ("w", 2.0, 0.0)):
        assert_allclose([s["travel"] for s in tried("backlash", joint, about)], [1e-5 * way, 1e-4 * way, 1e-3 * way])
        bristles = [s["distance"] for s in tried("lugre", joint, about)]
        assert_allclose(bristles, np.geomspace(1e-4 * way, 0.1 * way, 11))
        waves = [s["period"] for s in tried("cart_tilt", joint, about)]
        assert_allclose(waves, [2 * way, way / 0.75, way, way / 1.5, way / 2, way / 3, way / 4])
        for s in tried("position_friction", joint, about):
            assert (s["middle"], s["half"]) == (middle, way / 2)


@pytest.mark.parametrize(
    ("duration", "degrees"), [(1.0, [2]), (14.9, [2]), (15.0, [2, 5]), (24.0, [2, 5, 8]), (36.0, [2, 5, 8, 12])]
)
def test_friction_along_the_way_takes_three_seconds_a_term(duration: float, degrees: list[int]) -> None:
    """A parabola always; higher polynomials as the recording is long."""
    assert [s["degree"] for s in tried("position_friction", "x", scene(duration=duration))] == degrees


def test_friction_peaks_are_tried_between_what_was_slow_and_a_third_of_what_was_fast() -> None:
    """From half the slowest sure speed, at most a factor 1.6 apart; of the second power wider by `sqrt(3)`."""
    for joint, slow, fast in (("x", 0.01, 1.0), ("w", 0.05, 3.0)):
        grid = tried("stribeck", joint, scene())
        one, two = ([s["speed"] for s in grid if s["power"] == power] for power in (1.0, 2.0))
        assert_allclose([one[0], one[-1]], [0.5 * slow, fast / 3])
        assert_allclose(two, np.sqrt(3) * np.array(one))
        steps = np.array(one[1:]) / one[:-1]
        assert np.all(steps <= 1.6 + 1e-9) and np.all(steps > 1.5) and len(grid) == 2 * len(one)
    barely = replace(scene("x"), fast=np.array([0.015]))
    assert tried("stribeck", "x", barely) == []


def test_waves_of_a_force_are_shorter_than_those_of_a_position() -> None:
    """Four in the range for a force, one and a half for a displacement; a quarter of a wave apart."""
    for name, fewest in (("cyclic_ripple", 4.0), ("transmission_error", 1.5)):
        lines = 1 / np.array([s["period"] for s in tried(name, "x", scene())])
        assert lines[0] == pytest.approx(fewest / 0.5)
        assert_allclose(np.diff(lines), 1 / (4 * 0.5))
        assert 1000 - 0.5 <= lines[-1] < 1000  # 500 in half a metre; at 0.01 m/s 60 Hz would let 3000 a metre through
        seen = 1 / np.array([s["period"] for s in tried(name, "x", scene(cutoff_hz=4.0))])
        assert 200 - 0.5 <= seen[-1] < 200  # 4 Hz / (2 0.01 m/s)
        still = replace(scene("x", cutoff_hz=4.0), slow=np.zeros(1))
        assert 999 < 1 / tried(name, "x", still)[-1]["period"] < 1000


@pytest.mark.parametrize(
    ("duration", "ms"),
    [(0.04, []), (0.05, [0.5]), (0.2, [0.5, 2]), (1.0, [0.5, 2, 5, 10]), (120.0, [0.5, 2, 5, 10, 20, 35, 50, 70, 100])],
)
def test_delays_of_both_signs_are_tried_up_to_a_hundredth_of_the_recording(duration: float, ms: list[float]) -> None:
    """From the earliest to the latest; up to 1 ms the difference is taken to both sides, the same for both signs."""
    found = [1e3 * s["about"] for s in tried("delay", "x", scene(duration=duration))]
    assert_allclose(found, [*(-x for x in reversed(ms) if x > 1), *ms])


@pytest.mark.parametrize(("duration", "longest"), [(9.0, None), (9.3, 3.1), (18.0, 6.0), (120.0, 40.0)])
def test_lags_are_tried_from_three_seconds_to_a_third_of_the_recording(duration: float, longest: float | None) -> None:
    """None first; then at most doublings, both ends among them."""
    lags = [s["lag"] for s in tried("thermal_drift", "x", scene(duration=duration))]
    assert lags[0] == 0.0
    if longest is None:
        assert lags == [0.0]
    else:
        assert_allclose([lags[1], lags[-1]], [3.0, longest])
        assert np.all(np.diff(np.log2(lags[1:])) <= 1 + 1e-9) and len(lags) == 2 + np.ceil(np.log2(longest / 3.0))


def test_springs_are_tried_before_and_behind_friction_where_that_is_known() -> None:
    """The rigid bodies' force must be given for the second."""
    assert tried("joint_compliance", "x", scene("x", "force")) == [{"friction": 1.0}]
    assert tried("joint_compliance", "x", scene("x", "force", "rigid_force")) == [{"friction": 1.0}, {"friction": 0.0}]


def test_hysteresis_is_a_displacement_where_the_load_is_seen() -> None:
    """By a measured tool or an encoder behind the drive; else a force."""
    for signals, displaced in (
        ((), 0),
        (("load",), 0),
        (("tool",), 1),
        (("load_side",), 1),
        (("tool", "load_side"), 1),
    ):
        assert {s["displaced"] for s in tried("hysteresis", "x", scene("x", *signals))} == {displaced}


def test_what_has_no_settings_is_tried_once_a_joint() -> None:
    """Each joint alone, with nothing to choose; carts are the slides among them, shared motors pairs of one kind."""
    for name in (
        "quadratic_drag",
        "torque_offset",
        "coulomb_asymmetry",
        "viscous_asymmetry",
        "load_friction",
        "drive_gain",
    ):
        assert EFFECTS[name].groups(scene()) == [("x",), ("y",), ("w",)] and tried(name, "x", scene()) == [{}]
    for name in ("guideway_compliance", "cart_tilt"):
        assert EFFECTS[name].groups(scene()) == [("x",), ("y",)]
    assert EFFECTS["reducer_coupling"].groups(scene()) == [("x", "y")]
    assert EFFECTS["delay"].groups(scene()) == [("x", "y", "w"), ("x",), ("y",), ("w",)]
    assert EFFECTS["passive_joint_friction"].groups(scene()) == []
    assert EFFECTS["passive_joint_friction"].groups(scene("xyw", "passive")) == [("x", "y", "w")]


@pytest.mark.parametrize(
    ("name", "given", "missing"),
    [
        ("load_friction", (), "the logs give no load"), ("load_friction", ("load",), None),
        ("thermal_drift", ("load",), "the logs give no temperature"), ("drive_gain", (), "the logs give no force"),
        ("passive_joint_friction", (), "the robot has no loops and so no passive joints"),
        ("friction_change", ("campaign",), "there is only one training log"), ("quadratic_drag", (), None),
        ("joint_compliance", ("inertia", "damping", "weight_gradient"), "the logs give no force"),
        ("joint_compliance", ("inertia", "damping", "weight_gradient", "force"), None),
        ("joint_compliance", ("tool", "force"), None),
        ("backlash", ("inertia", "damping", "weight_gradient", "reversal"), "play shows in forces only at reversals"),
        ("backlash", ("tool",), "the logs give no reversal"), ("backlash", ("load_side", "reversal"), None),
        ("hysteresis", ("inertia", "damping", "reversal"), "forces do not show the loop"),
        ("lugre", (), "the logs give no reversal"), ("lugre", ("reversal",), None),
        ("directional_efficiency", (), "the logs give no load"), ("directional_efficiency", ("load", "reducer_torque"), None),
        ("torque_speed_limit", ("reported_force",), "the robot file gives no effort"),
        ("cogging", (), "the robot file gives no gear ratio"),
        ("guideway_compliance", ("side_force",), "no measured tool positions are looked at here"),
        ("cart_tilt", ("cart_sensitivity",), None),
    ],
)  # fmt: skip
def test_what_is_missing_is_named_with_the_experiment_that_gives_it(
    name: str, given: tuple[str, ...], missing: str | None
) -> None:
    """The first of what an effect feels; where the load is seen directly, no force has to be explained by it."""
    why = EFFECTS[name].untestable(scene("xyw", *given))
    if missing is None:
        assert why is None
    else:
        experiment = NO_EXPERIMENT if missing.startswith("the robot has no") else EFFECTS[name].reveals
        assert why is not None and why[0].startswith(missing) and why[1] == experiment


def test_of_two_logs_the_second_differs_and_of_three_each_may() -> None:
    """The first of two differs from the second by as much, with the other sign."""
    for campaigns, numbers in ((1, []), (2, [1]), (3, [0, 1, 2]), (5, [0, 1, 2, 3, 4])):
        about = replace(scene("x", "campaign"), campaigns=campaigns)
        assert [s["number"] for s in tried("friction_change", "x", about)] == numbers
        assert (EFFECTS["friction_change"].untestable(about) is None) is (campaigns > 1)
    unnumbered = replace(scene("x"), campaigns=2)
    assert EFFECTS["friction_change"].untestable(unnumbered) == (
        "the logs give no campaign",
        EFFECTS["friction_change"].reveals,
    )
