"""Causes in actuators: what a gear loses each way, bristles, compensated friction, cogging, a motor's torque-speed line."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS, REPORTED, Motion, Scene
from tau_dyn.robot import load_robot_from_urdf

T = np.arange(0, 4, 1e-3)


def cause(name: str, **settings: float) -> Any:
    return cast("Any", EFFECTS[name](["x"], ["N m"], **cast("Any", settings)))


def moving(v: np.ndarray, q: np.ndarray | None = None, **signals: np.ndarray) -> Motion:
    """Return one hinge at speeds (N,), with signals (N,)."""
    column = v[:, None]
    place = np.zeros_like(column) if q is None else q[:, None]
    t = None if q is None else T
    return Motion.of(("x",), place, column, 0 * column, t=t, signals={k: x[:, None] for k, x in signals.items()})


def force(effect: Any, motion: Motion, *values: float) -> np.ndarray:
    return effect.columns(motion)[:, 0] @ np.array(values)


def test_a_gear_loses_more_when_it_drives_than_when_it_is_driven():
    """Lifting 10 N m costs 3 N m more with 30 % loss, lowering it spares 1 N m with 10 %; the same with all signs turned."""
    load = np.array([10.0, 10.0, -10.0, -10.0])
    found = force(
        cause("directional_efficiency"),
        moving(np.array([1.0, -1.0, -1.0, 1.0]), reducer_torque=load, load=np.abs(load)),
        0.3,
        0.1,
    )
    assert_allclose(found, [3.0, -1.0, -3.0, 1.0])


def test_a_gear_never_gives_power(rng):
    """Whatever load and speed, the power lost is the loss times the power transmitted, and never negative."""
    load, v = rng.standard_normal((2, 500))
    lost = v * force(cause("directional_efficiency"), moving(v, reducer_torque=load, load=np.abs(load)), 0.4, 0.15)
    assert_allclose(lost, np.where(load * v > 0, 0.4, 0.15) * np.abs(load * v), atol=1e-12)


def test_equal_losses_are_load_friction_and_their_difference_scales_the_load(rng):
    """One mechanism: 20 % each way are load friction of 20 %; 5 % more one way and less the other are 5 % of the load."""
    load, v = rng.standard_normal((2, 500))
    motion, gear = moving(v, reducer_torque=load, load=np.abs(load)), cause("directional_efficiency")
    assert_allclose(force(gear, motion, 0.2, 0.2), force(cause("load_friction"), motion, 0.2), atol=1e-12)
    assert_allclose(force(gear, motion, 0.25, 0.15) - force(gear, motion, 0.2, 0.2), 0.05 * load, atol=1e-12)


def test_a_bristle_is_a_spring_before_it_slips():
    """Around rest the force changes by lugre / distance for each radian: 6 N m over 2 mrad are 3 kN m/rad."""
    effect, dq = cause("lugre", distance=2e-3), 1e-8
    z = effect.followed(np.array(0.0), np.array(dq))
    assert_allclose(6.0 * z / dq, 3e3, rtol=1e-5)
    assert "3 kN m/rad" in effect.describe(effect.parameters.with_values(np.array([6.0])))


def test_a_bristle_in_place_of_coulomb_friction_takes_energy(rng):
    """Over random small loops, Coulomb friction whose whole the bristle carries never gives more than it got."""
    q = 1e-3 * np.cumsum(rng.standard_normal(len(T)))
    v = np.gradient(q, T)
    effect = cause("lugre", distance=2e-3)
    z = effect.find_state(type("J", (), {"signals": {}, "signal": lambda self, n: 0 * q, "t": T, "q": q})())
    work = np.cumsum((z[1:] + z[:-1]) / 2 * np.diff(q))
    assert work.min() > -2e-3  # what it held at the start
    assert work[-1] > 0 and np.abs(z).max() <= 1
    assert_allclose(effect.columns(moving(v, q, reversal=0 * q))[:, 0, 0], z - np.sign(v), atol=1e-12)


def test_lugre_is_what_a_bristle_of_hysteresis_does_to_forces(rng):
    """One law under two names: the force that model files of a hysteresis hold."""
    q = 0.1 * np.sin(3 * T) + 0.02 * np.sin(17 * T)
    motion = moving(np.gradient(q, T), q, reversal=np.abs(q))
    assert_allclose(cause("lugre", distance=0.01).columns(motion), cause("hysteresis", distance=0.01).columns(motion))


def test_static_friction_keeps_its_height_and_ends():
    """At half the speed at which compensation sets in, all of it stands, in the direction of motion; at 1.3 of it none."""
    found = force(cause("static_friction", speed=0.1), moving(np.array([0.05, -0.05, 0.13, -0.2])), 0.5)
    assert_allclose(found, [0.498, -0.498, 0.0, 0.0], atol=2e-3)


def test_force_beyond_the_torque_speed_line_is_lost():
    """Stall 10 N m, no load at 4 rad/s: at 1 rad/s at most 7.5 N m come of 9 N m; braking and beyond no load are apart."""
    v, asked = np.array([1.0, 1.0, -1.0, 5.0, 1.0]), np.array([9.0, 7.0, -9.0, 2.0, -9.0])
    found = force(cause("torque_speed_limit", stall=10.0, no_load=4.0), moving(v, **{REPORTED: asked}), 1.0)
    assert_allclose(found, [1.5, 0.0, -1.5, 2.0, 0.0])
    assert cause("torque_speed_limit").measured


def test_a_share_far_from_one_is_no_limit():
    """Noise in the logged force makes a few per cent of an excess; that is refused in the search as at the end."""
    effect = cause("torque_speed_limit", stall=10.0, no_load=4.0)
    for lost, fits in ((0.05, False), (0.8, True), (1.2, True), (1.5, False)):
        values = effect.parameters.with_values(np.array([lost]))
        assert all((effect.find_implausible(values, {}, margin) == "") is fits for margin in (1.0, 5.0))


DRIVE = """<robot name="one"><link name="base_link"/><link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"
 ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="x" type="revolute"><parent link="base_link"/><child link="arm"/>
 <axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="3" effort="9"/></joint><transmission name="d"><joint name="x"/>
 <actuator name="m">{gear}</actuator></transmission></robot>"""


@pytest.mark.parametrize(
    ("gear", "ratios"),
    [
        ("<mechanicalReduction>50</mechanicalReduction>", {"x": 50.0}),
        ('<drake:gear_ratio xmlns:drake="http://drake.mit.edu" value="-8"/>', {"x": 8.0}),
        ("", {}),
        ("<mechanicalReduction>1</mechanicalReduction>", {}),
    ],
)
def test_the_robot_file_tells_gear_ratios(gear: str, ratios: dict[str, float]):
    """Of ROS or Drake, whichever way the motor turns; none where nothing or no gear is given."""
    assert load_robot_from_urdf(DRIVE.format(gear=gear), "one").gear_ratios == ratios


def scene(**ratios: float) -> Scene:
    one = np.ones(1)
    return Scene(("x",), ("N m",), -one, one, 0.01 * one, 2 * one, 20.0, 60.0, ratios=ratios)


def test_cogging_repeats_a_whole_number_of_times_a_motor_turn():
    """Behind a gear of 50 the periods tried are 2 pi / 50 over whole numbers, the first where the range holds four."""
    cls = EFFECTS["cogging"]
    orders = [2 * np.pi / (50 * row["period"]) for row in cls.grid(scene(x=50.0), ("x",))]
    assert_allclose(orders, np.arange(1, len(orders) + 1), rtol=1e-9)
    assert len(orders) == 31  # 2 rad / 500 is the shortest period
    effect = cls(["x"], ["N m"]).with_settings(**cls.grid(scene(x=50.0), ("x",))[3])
    q = np.linspace(0, 2 * np.pi / 50, 401)
    turn = effect.columns(moving(np.ones(401), q))[:, 0, 0]
    assert_allclose(turn, np.sin(4 * 50 * q), atol=1e-12)
    assert "4 times a motor turn" in effect.describe(effect.parameters.with_values(np.array([3.0, 4.0])))


def test_without_a_gear_ratio_cogging_is_not_told_from_a_ripple():
    """Then any period of the motor is one of the joint, and the answer says so."""
    why = EFFECTS["cogging"].untestable(scene())
    assert why is not None and "cyclic_ripple" in why[0] and EFFECTS["cogging"].grid(scene(), ("x",)) == []
    assert EFFECTS["cogging"].untestable(scene(x=50.0)) is None
