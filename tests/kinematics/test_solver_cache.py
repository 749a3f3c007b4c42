"""Solvers live as long as what they solve, and no longer."""

from __future__ import annotations

import copy
import gc
import weakref

import pytest

from tau_dyn.mechanism import forward_kinematics, get_rods, get_solver, inverse_kinematics, jacobian
from tau_dyn.robot import load_robot


@pytest.mark.parametrize("name", ["gantry_tau", "stewart", "linear_axis"])
def test_dropping_a_robot_frees_its_solvers(name):
    """After the last reference to a robot goes, neither the robot nor its rods nor its solver stays in memory."""
    robot = load_robot(name)
    poses = forward_kinematics(robot, robot.home[None]).poses
    inverse_kinematics(robot, poses)
    jacobian(robot, robot.home[None])
    gone = [weakref.ref(robot), weakref.ref(get_solver(robot))]
    rods = get_rods(robot)
    gone += [] if rods is None else [weakref.ref(rods)]
    del robot, rods, poses
    gc.collect()
    assert [ref() for ref in gone] == [None] * len(gone)


def test_a_solver_is_made_once_and_not_copied():
    """The second call takes the first one's solver; a copy of the robot makes its own."""
    robot = load_robot("gantry_tau")
    assert get_solver(robot) is get_solver(robot) and get_rods(robot) is get_rods(robot)
    assert get_rods(copy.deepcopy(robot)) is not get_rods(robot)
