"""Plans for a serial arm and for loops that are closed by the solver."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.control.motion import MotionLimits, plan_motion
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

pytest.importorskip("casadi")

IRB140 = Path(__file__).parents[3] / "experiments" / "lead_through_parts" / "irb140.urdf"


def test_a_serial_arm_moves_within_its_torques_and_speeds():
    """A 6-axis arm of the IRB 140's kind: Pinocchio's torques along the plan stay within the limits, and some reach them."""
    model = Model.of(load_robot(IRB140))
    torque = np.array([300.0, 300, 150, 50, 50, 30])
    end = np.array([0.8, 0.3, -0.2, 0.2, 0.3, 0.1])
    plan = plan_motion(model, np.zeros(6), end, joints=True, limits=MotionLimits.of(model, force=torque), nodes=20)
    share = np.abs(model.mechanism.inverse_dynamics(plan.q, plan.v, plan.a)) / torque
    assert 0.99 < share.max() < 1.01
    assert np.max(np.abs(plan.v) / model.robot.velocity_limit) < 1.01
    assert_allclose(plan.q[[0, -1]], [np.zeros(6), end], atol=1e-12)
    assert np.max(end / model.robot.velocity_limit) < plan.duration < plan.start_duration


def test_loops_closed_by_the_solver_give_the_closed_forms_motion():
    """With all rods, joints and loops the Gantry-Tau moves as in closed form: the rods' masses are at their ends in both."""
    ends = [1.625, -0.65, 0.71], [2.0, -0.5, 0.83]
    found = []
    for arms in ("simplified", "complete"):
        model = Model.of(load_robot("gantry_tau", arms=arms))
        limits = MotionLimits.of(model, force=300.0)
        found.append(plan_motion(model, *ends, limits=limits, energy_weight=1e-6, nodes=10))
    assert_allclose(found[1].duration, found[0].duration, rtol=1e-6)
    assert_allclose(found[1].energy, found[0].energy, rtol=1e-4)
