"""Solvers are kept beside the robots that were used last, and nothing is written on robots."""

from __future__ import annotations

import copy
import gc
import weakref
from dataclasses import replace
from threading import Thread

import pytest

from tau_dyn.mechanism import build_kinematics, forward_kinematics, get_rods, get_solver, inverse_kinematics, jacobian
from tau_dyn.robot import load_robot

_MORE_THAN_ARE_KEPT = 20


@pytest.mark.parametrize("name", ["gantry_tau", "stewart", "linear_axis"])
def test_robots_that_were_not_used_for_long_go_with_their_solvers(name):
    """After many other robots, neither a dropped robot nor its rods nor its solver stays in memory."""
    robot = load_robot(name)
    before = set(vars(robot))
    poses = forward_kinematics(robot, robot.home[None]).poses
    inverse_kinematics(robot, poses)
    jacobian(robot, robot.home[None])
    assert set(vars(robot)) == before
    gone = [weakref.ref(robot), weakref.ref(get_solver(robot))]
    rods = get_rods(robot)
    gone += [] if rods is None else [weakref.ref(rods)]
    other = load_robot("linear_axis")
    for _ in range(_MORE_THAN_ARE_KEPT):
        build_kinematics(replace(other))
    del robot, rods, poses
    gc.collect()
    assert [ref() for ref in gone] == [None] * len(gone)


def test_a_solver_is_made_once_and_not_copied():
    """The second call takes the first one's solver; a copy of the robot makes its own, and so does a thread."""
    robot = load_robot("gantry_tau")
    assert get_solver(robot) is get_solver(robot) and get_rods(robot) is get_rods(robot)
    assert get_rods(copy.deepcopy(robot)) is not get_rods(robot)
    found = []
    thread = Thread(target=lambda: found.append(build_kinematics(robot)))
    thread.start()
    thread.join()
    assert found[0] is not build_kinematics(robot)
