"""Encoders whose zero is off: the force is that of the body at the displaced positions, exactly, whatever the angle."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import JointZero, Scene, interpolate_shifts
from tau_dyn.effects.joint_zero import SHIFTS
from tau_dyn.model import Model
from tau_dyn.simulate import Sensors, measure, move, simulate_drive


@pytest.mark.parametrize("zero", [-1.3, -0.3, 1e-9, 0.005, 0.3])
def test_a_hinges_force_is_exact_at_any_zero(two_link, rng, zero: float) -> None:
    """Rigid body and effect along `q` give the rigid body's force at `q - zero`, at the shoulder as at the elbow."""
    q, v, a = rng.standard_normal((3, 20, 2))
    for k, joint in enumerate(two_link.actuated):
        effect = JointZero([joint], ["N m"], about=zero)
        model = Model.of(two_link, [effect]).with_values({f"{joint}.joint_zero": zero})
        moved = q - zero * np.eye(2)[k]
        expected = model.mechanism.inverse_dynamics(moved, v, a)
        assert_allclose(model.torque(q, v, a, t=np.arange(20) * 0.01), expected, atol=1e-9)


@pytest.mark.parametrize("unit", ["N", "N m"])
def test_no_zero_is_the_derivative(unit: str) -> None:
    """At a shift of nothing the weights give the derivative of a line, and a shift of one node gives that node."""
    nodes = SHIFTS[unit]
    function = np.sin(nodes) if unit == "N m" else nodes
    assert_allclose(interpolate_shifts(0.0, unit) @ function, 1.0, rtol=1e-9)
    assert_allclose(interpolate_shifts(nodes[3], unit) * nodes[3], [0, 0, 0, 1], atol=1e-9)


def test_a_weighed_slide_carries_no_zero(block, rng) -> None:
    """A level slide feels no force of its place: the columns are zero."""
    model = Model.of(block, [JointZero(["axis"], ["N"])])
    q, v, a = rng.standard_normal((3, 10, 1))
    columns = model.regressor(q, v, a, t=np.arange(10) * 0.01)
    assert_allclose(columns[:, :, -1], 0.0, atol=1e-9)


def test_the_zero_that_fits_best_is_tried(rng) -> None:
    """A proposed zero of 0.2 rad is the middle of three; a proposal of nothing gives the smallest setting."""
    one = np.ones(1)
    scene = Scene(("x",), ("N m",), -one, one, 0.01 * one, one, 60.0, 100.0, zeros={"x": 0.2})
    assert_allclose([s["about"] for s in JointZero.grid(scene, ("x",))], [0.15, 0.2, 0.25])
    none = Scene(("x",), ("N m",), -one, one, 0.01 * one, one, 60.0, 100.0)
    assert [s["about"] for s in JointZero.grid(none, ("x",))][1] == 1e-3


def test_absorbed_zeros_have_a_reason() -> None:
    """A base's yaw is felt by no force; a last joint's zero is its centre of mass elsewhere."""
    assert JointZero.explain_absorbed(("pan",), False) == "no force depends on the position of pan"
    assert "alias of the centre of mass" in JointZero.explain_absorbed(("elbow",), True)


def test_a_simulated_encoder_reads_its_zero(two_link) -> None:
    """The log's positions are the true ones and the zero, and the robot moves as without it."""
    model = Model.of(two_link, [JointZero(["elbow"], ["N m"])]).with_values({"elbow.joint_zero": 0.2})
    rest = np.zeros(2)
    motion = move(two_link.actuated, rest, np.array([0.1, -0.1]), 0.2)
    run = simulate_drive(model, motion, None, Sensors(), np.random.default_rng(0), feedback="ideal")
    log = measure(run, Sensors(), np.random.default_rng(0))
    assert_allclose(log["q_elbow"], run.q[:, 1] + 0.2, atol=1e-12)
    assert_allclose(log["q_shoulder"], run.q[:, 0], atol=1e-12)
