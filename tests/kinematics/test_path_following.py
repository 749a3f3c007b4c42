"""A path in one branch: what went in comes back, and where the branch ends is told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics import follow_path
from tau_dyn.kinematics.path_following import _moved
from tau_dyn.mechanism import Poses, forward_kinematics, solve_all_configurations
from tau_dyn.robot import load_robot


@pytest.mark.parametrize(
    ("name", "arguments"), [("gantry_tau", {"arms": "complete"}), ("gantry_tau_f1", {}), ("h4", {})]
)
def test_a_path_comes_back(name, arguments):
    """Poses along a motion near home give its positions again, whatever solves the robot."""
    robot = load_robot(name, **arguments)
    t = np.linspace(0, 2, 20)[:, None]
    q = robot.home + 0.05 * np.sin(t * (1 + 0.3 * np.arange(robot.na)))
    found = follow_path(robot, forward_kinematics(robot, q).poses)
    assert found.until == 20 and found.reason == ""
    assert_allclose(found.q, q, atol=1e-9)


def test_the_branch_is_the_starts():
    """Started with a cart on the other side of its rod, every sample keeps it there; without a start it is home's."""
    robot = load_robot("gantry_tau")
    t = np.linspace(0, 1, 10)[:, None]
    poses = forward_kinematics(robot, robot.home + 0.1 * t * np.array([1.0, -1.0, 0.5])).poses
    every = solve_all_configurations(robot, poses)
    whole = 0
    for k in range(every.shape[1]):
        found = follow_path(robot, poses, start=every[0, k])
        assert_allclose(found.q[found.ok], every[found.ok, k], atol=1e-10)
        assert found.reason in ("", "parallel singularity")  # other branches have theirs elsewhere
        whole += found.reason == ""
    assert whole >= 4
    assert_allclose(follow_path(robot, poses).q, follow_path(robot, poses, start=robot.home).q, atol=1e-12)


def test_a_stewart_platform_stops_at_a_quarter_turn():
    """Turned about its axis it is singular at 90 degrees, whatever its size (Fichter 1986): the path ends there."""
    robot = load_robot("stewart")
    home = forward_kinematics(robot, robot.home).poses
    angle = np.linspace(0, 2.2, 100)
    turn = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    found = follow_path(robot, Poses(np.repeat(home.position, 100, axis=0), turn @ home.rotation))
    assert found.reason == "parallel singularity"
    assert np.interp(found.crossing, np.arange(100), angle) == pytest.approx(np.pi / 2, abs=1e-3)
    assert np.isfinite(found.q[found.ok]).all() and np.isnan(found.q[~found.ok]).all()


def test_a_path_out_of_reach_ends_there():
    """What lies before the first pose out of reach stands; driven positions end likewise."""
    robot = load_robot("gantry_tau")
    home = forward_kinematics(robot, robot.home).poses
    away = home.position + np.linspace(0, 3, 30)[:, None] * np.array([0.0, 0.0, -1.0])
    found = follow_path(robot, Poses(away, np.repeat(home.rotation, 30, axis=0)))
    assert 2 < found.until < 30 and found.reason == "out of reach"
    apart = robot.home + np.linspace(0, 5, 30)[:, None] * np.array([1.0, -1.0, 0.0])
    driven = follow_path(robot, apart)
    assert 2 < driven.until < 30 and driven.reason == "out of reach"
    assert_allclose(driven.q[driven.ok], apart[driven.ok])
    assert np.isfinite(driven.poses.position[driven.ok]).all()


def test_what_makes_no_path_is_refused():
    """No samples, or positions with a start."""
    robot = load_robot("gantry_tau")
    with raises_code("too_little_data"):
        follow_path(robot, np.zeros((0, 3)))
    with raises_code("invalid_value"):
        follow_path(robot, np.zeros((2, 3)), start=robot.home)


def test_whole_turns_are_no_steps():
    """From 175 to -175 degrees a joint turns by 10 degrees; a slide's step counts by the legs' length."""
    machine: Any = SimpleNamespace(
        robot=SimpleNamespace(joint_kinds=("revolute", "prismatic")), legs=SimpleNamespace(lengths=np.array([1.5, 2.5]))
    )
    assert_allclose(_moved(machine, np.deg2rad([[-350.0, 0.0], [350.0, 0.0], [-10.0, 0.0]])), np.deg2rad(10))
    assert_allclose(_moved(machine, np.array([0.01, -0.3])), 0.15)
