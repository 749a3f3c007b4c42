"""Causes of time, speed and mounting: late and low-passed forces, friction that bends, gravity that leans, guideways askew."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import (
    EFFECTS,
    GUIDE_ACROSS,
    SENSITIVITY,
    Delay,
    DriveLag,
    Effect,
    GuidewayNonparallel,
    Motion,
    Scene,
    apply_first_order_lowpass,
)
from tau_dyn.evidence.settings import find_edge
from tau_dyn.mechanism import GantryTauMechanism, TreeMechanism, build_mechanism
from tau_dyn.mechanism.mechanism import compute_perpendicular_axes
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf


def line(v: Any = 0.0, a: Any = 0.0, t: np.ndarray | None = None, **signals: Any) -> Motion:
    """Return the motion of one slide."""
    v, a = (np.array(np.broadcast_arrays(x, v, a)[0], float).reshape(-1, 1) for x in (v, a))
    return Motion.of(
        ("x",), 0 * v, v, a, t=t, signals={k: np.asarray(s, float).reshape(-1, 1) for k, s in signals.items()}
    )


def cause(name: str, **settings: float) -> Effect:
    return EFFECTS[name](["x"], ["N"], **cast("Any", settings))


def test_a_low_pass_turns_and_shrinks_a_sine_as_its_transfer_function_says() -> None:
    """5 Hz behind 20 ms: `1 / (1 + j w T)`, 0.847 of the size and 32.1 degrees late, once it has settled."""
    t = np.arange(0, 2, 1e-3)
    w, T = 2 * np.pi * 5, 0.02
    response = 1 / (1 + 1j * w * T)
    assert abs(response) == pytest.approx(0.8467, abs=1e-4)
    late = apply_first_order_lowpass(np.sin(w * t), t, T)
    assert_allclose(late[300:], np.imag(response * np.exp(1j * w * t))[300:], atol=2e-4)


def test_a_step_behind_a_low_pass_rises_by_its_time_constant() -> None:
    """63.2 % after one time constant; of a constant force nothing changes."""
    t = np.arange(0, 0.2, 1e-4)
    step = (t >= 0.05).astype(float)
    late = apply_first_order_lowpass(step, t, 0.01)
    assert np.interp(0.06, t, late) == pytest.approx(1 - np.exp(-1), abs=0.01)
    assert_allclose(apply_first_order_lowpass(np.full(5, 7.0), t[:5], 0.01), 7.0)


def test_a_lag_of_its_own_setting_is_the_low_passed_force_exactly() -> None:
    """`F + T (LP(F) - F) / T`: where amplitude and setting agree nothing is left out."""
    t = np.arange(0, 2, 2e-3)
    F = 100 * np.sin(2 * np.pi * 3 * t) + 20 * np.sign(np.sin(2 * np.pi * t))
    effect = cause("drive_lag", about=0.03)
    logged = F + effect.force(line(1.0 + 0 * t, t=t, force=F), effect.parameters.with_values(np.array([0.03])))[:, 0]
    assert_allclose(logged, apply_first_order_lowpass(F, t, 0.03), atol=1e-9)


@pytest.mark.parametrize("late", [0.06, -0.04])
def test_a_long_delay_of_its_own_setting_is_the_late_force_exactly(late: float) -> None:
    """60 ms of a force with steps: beyond 1 ms both parts of the difference count."""
    t = np.arange(0, 2, 1e-3)

    def force(t: np.ndarray) -> np.ndarray:
        return 100 * np.sin(2 * np.pi * 2 * t) + 30 * np.tanh(40 * np.sin(2 * np.pi * 0.7 * t))

    effect = cause("delay", about=late)
    logged = (
        force(t)
        + effect.force(line(1.0 + 0 * t, t=t, force=force(t)), effect.parameters.with_values(np.array([late])))[:, 0]
    )
    assert_allclose(logged[100:-100], force(t - late)[100:-100], atol=0.05)


def test_short_delays_and_short_low_passes_are_one_thing() -> None:
    """Below 5 ms a delay names the low-pass as its twin, and low-passes are tried from there on."""
    assert (
        "drive_lag" in cause("delay", about=2e-3).equivalent
        and "drive_lag" not in cause("delay", about=0.02).equivalent
    )
    one = np.ones(1)
    about = Scene(("x",), ("N",), 0 * one, one, 0.01 * one, one, 60.0, 120.0)
    assert min(s["about"] for s in DriveLag.grid(about, ("x",))) == 5e-3
    assert "delay" in cause("drive_lag", about=5e-3).equivalent and not cause("drive_lag", about=0.02).equivalent
    assert {abs(s["about"]) for s in Delay.grid(about, ("x",))} >= {5e-4, 0.1}


def test_friction_that_levels_off_gives_its_amplitude_at_high_speed() -> None:
    """Power 0: in proportion to the speed below the knee, 10 N far above it; the square root of two below at the knee."""
    effect = cause("viscous_curvature", knee=0.1, power=0.0)
    columns = effect.columns(line([1e-4, 0.1, -0.1, 50.0]))[:, 0, 0]
    assert_allclose(10 * columns, [0.01, 10 / np.sqrt(2), -10 / np.sqrt(2), 10], rtol=1e-5)


@pytest.mark.parametrize(("power", "slope"), [(0.0, 0.0), (0.5, 0.5), (1.5, 1.5)])
def test_curved_friction_grows_with_its_power_above_the_knee(power: float, slope: float) -> None:
    """Doubling a high speed multiplies the force by `2^power`; it always brakes."""
    effect = cause("viscous_curvature", knee=0.01, power=power)
    one, two, back = effect.columns(line([5.0, 10.0, -5.0]))[:, 0, 0]
    assert np.log2(two / one) == pytest.approx(slope, abs=1e-3) and back == -one < 0


def test_a_setting_is_at_the_edge_of_what_was_tried_with_the_others_the_same() -> None:
    """Knees of power 0 begin at 0.04, so it is an edge though others are tried from 0.03 on; 0.4 is none.

    The least knee of another power is none either: below it the law is the plain power.
    """
    one = np.ones(1)
    scene = Scene(("x",), ("N",), 0 * one, one, 0.01 * one, one, 35.0, 120.0)
    assert "edge" in find_edge([cause("viscous_curvature", knee=0.04, power=0.0)], scene)
    assert not find_edge([cause("viscous_curvature", knee=0.4, power=0.0)], scene)
    assert not find_edge([cause("viscous_curvature", knee=0.03, power=0.5)], scene)
    assert "edge" in find_edge([cause("viscous_curvature", knee=0.1, power=0.5)], scene)


def test_a_rotors_error_acts_with_the_acceleration() -> None:
    """0.5 kg more than the file says take 1 N at 2 m/s^2; a confirmed one corrects a parameter."""
    effect = cause("armature")
    assert_allclose(effect.force(line(0.0, [2.0, -2.0]), effect.parameters.with_values(np.array([0.5])))[:, 0], [1, -1])
    assert EFFECTS["armature"].confirmed_as == "parameter" and EFFECTS["delay"].confirmed_as == "confirmed"


@pytest.fixture
def arm(write) -> Robot:
    """A column about a vertical axis, then a hinge about a horizontal one, off all axes."""
    base = write.link("column_link", 5, "0.05 0.02 0.1", "0.1 0.1 0.1") + write.joint(
        "turn", "revolute", "base_link", "column_link"
    )
    upper = write.link("upper_link", 3, "0.2 0.03 0.01", "0.01 0.05 0.05")
    hinge = write.joint("lift", "revolute", "column_link", "upper_link", "0 1 0", "0.1 0 0.2")
    return load_robot_from_urdf(write.text("arm", base, upper, hinge, write.drive("turn"), write.drive("lift")), "arm")


def test_a_turn_of_gravity_is_pinocchios_with_gravity_turned(arm, rng) -> None:
    """The torque at rest under gravity turned by 1e-6 rad less that under gravity as it was, per radian, at every sample."""
    model, step = arm.model_with(arm.parameters), 1e-6
    q = rng.uniform(-2, 2, (30, 2))
    turned = TreeMechanism(arm).gravity_turn(q)
    assert turned.shape == (30, 2, 2)
    for k, axis in enumerate(np.eye(3)[:2]):
        both = []
        for angle in (step, -step):
            other = pin.Model(model)
            other.gravity.linear = pin.exp3(angle * axis) @ np.array([0, 0, -9.81])
            data = other.createData()
            both.append(np.array([pin.computeGeneralizedGravity(other, data, x) for x in q]))
        assert_allclose(turned[:, :, k], (both[0] - both[1]) / (2 * step), atol=1e-6)
    assert np.abs(turned[:, 0]).max() > 1  # the vertical axis feels a tilt, which the nominal gravity never shows


def test_both_forms_of_the_gantry_feel_the_same_tilt(rng) -> None:
    """Closed form and tree agree on what a turn of gravity does to the carts."""
    robot = load_robot("gantry_tau")
    q = robot.home + rng.uniform(-0.2, 0.2, (20, 3))
    closed, tree = GantryTauMechanism(robot), TreeMechanism(robot)
    assert_allclose(closed.gravity_turn(q), tree.gravity_turn(q), atol=1e-6)
    assert isinstance(build_mechanism(robot), GantryTauMechanism)


def test_a_tilt_is_what_the_signal_says_on_all_joints(rng) -> None:
    """20 mrad about x and -10 about y, added up joint by joint."""
    effect = EFFECTS["gravity_direction"](["x", "y"], ["N", "N"])
    signal = rng.standard_normal((5, 2, 2))
    rest = np.zeros((5, 2))
    motion = Motion.of(("x", "y"), rest, rest, rest, signals={"gravity_turn": signal})
    assert effect.parameters.names == ("base.tilt_x", "base.tilt_y")
    assert_allclose(
        effect.force(motion, effect.parameters.with_values(np.array([0.02, -0.01]))), signal @ [0.02, -0.01]
    )


def test_axes_across_a_direction_are_unit_and_across() -> None:
    """Of a base axis the other two, in order; of any other two that stand on it and on each other."""
    assert_allclose(compute_perpendicular_axes(np.array([0, 0, -9.81])), np.eye(3)[:2])
    assert_allclose(compute_perpendicular_axes(np.array([2.0, 0, 0])), np.eye(3)[1:])
    lean = np.array([1.0, 2.0, 3.0])
    found = compute_perpendicular_axes(lean)
    assert_allclose(found @ found.T, np.eye(2), atol=1e-12)
    assert_allclose(found @ lean, 0, atol=1e-12)


def test_a_guideway_askew_shifts_the_tool(rng, tool_of) -> None:
    """1 mrad upwards and 0.5 aside at cart 2: spheres intersected anew around carts off their lines, to first order."""
    mechanism = GantryTauMechanism(load_robot("gantry_tau"))
    q = mechanism.robot.home + rng.uniform(-0.25, 0.25, (30, 3))
    across = np.broadcast_to(mechanism.guide_across(), (30, 3, 2, 3))
    signals = {SENSITIVITY: mechanism.cart_sensitivity(q), GUIDE_ACROSS: across}
    motion = Motion.of(("cart1", "cart2", "cart3"), q, 0 * q, 0 * q, signals=signals)
    effect = GuidewayNonparallel(("cart2",), ["N"])
    u = np.zeros((30, 3, 3))
    u[:, 1] = q[:, 1, None] * np.array([0, 5e-4, 1e-3])
    moved = tool_of(mechanism, q, u) - mechanism.tool_position(q)
    found = effect.tool_columns(motion, mechanism.tool_jacobian(q)) @ [5e-4, 1e-3]
    assert_allclose(found, moved, atol=2e-3 * np.abs(moved).max())
    assert effect.parameters.names == ("cart2.direction_y", "cart2.direction_z")
