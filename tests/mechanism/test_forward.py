"""Forward kinematics: independent of the way it is asked, in home's assembly mode, with a reason where there is no pose."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import LoopSolver, Poses, TreePose, build_rods, forward_kinematics
from tau_dyn.parameters import Parameters
from tau_dyn.robot import load_robot


def wave(robot, n: int, reach: float) -> np.ndarray:
    """Return a smooth motion (n, na) around home."""
    t = np.linspace(0, 4, n)[:, None]
    return robot.home + reach * np.sin(t * (1 + 0.3 * np.arange(robot.na)) + np.arange(robot.na))


@pytest.mark.parametrize(
    ("name", "arguments", "reach"),
    [
        ("gantry_tau", {}, 0.4),
        ("gantry_tau", {"arms": "complete", "prototype": "d1"}, 0.3),
        ("gantry_tau_f1", {}, 0.15),
        ("delta", {}, 0.3),
        ("stewart", {}, 0.05),
        ("gantry_tau_queensland", {}, 0.15),
    ],
)
def test_poses_are_those_of_the_tree(name, arguments, reach):
    """Points and distances give the pose that the tree's loops give, solved by other code."""
    robot = load_robot(name, **arguments)
    q = wave(robot, 40, reach)
    found = forward_kinematics(robot, q)
    tree, _ = TreePose(robot).forward(q)
    assert found.ok.all()
    assert_allclose(found.poses.position, tree.position, atol=1e-11)
    assert_allclose(found.poses.rotation, tree.rotation, atol=1e-11)


def test_a_pose_depends_on_its_own_positions_alone(rng):
    """Backwards, one by one or among others: the same bits up to rounding."""
    robot = load_robot("gantry_tau", arms="complete")
    q = robot.home + rng.uniform(-0.4, 0.4, (5, 3))
    whole = forward_kinematics(robot, q).poses.position
    assert_allclose(forward_kinematics(robot, q[::-1]).poses.position[::-1], whole, atol=1e-14)
    fresh = load_robot("gantry_tau", arms="complete")
    single = np.concatenate([forward_kinematics(fresh, one).poses.position for one in q])
    assert_allclose(single, whole, atol=1e-14)


def test_a_trajectory_does_not_jump():
    """Along a motion the plate moves as its Jacobian says, never further, also with a calibrated geometry."""
    robot = load_robot("gantry_tau", prototype="d1", arms="complete")
    q = wave(robot, 3000, 0.7)
    found = forward_kinematics(robot, q)
    assert found.ok.all()
    steps = np.linalg.norm(np.diff(found.poses.position, axis=0), axis=1)
    assert steps.max() < 4 * np.abs(np.diff(q, axis=0)).max()


def test_trilateration_has_two_solutions(rng):
    """Both hold all rods; they are mirrored in the carts' plane, and home's comes first (thesis 4.2)."""
    robot = load_robot("gantry_tau", prototype="d1")
    rods = build_rods(robot)
    q = robot.home + rng.uniform(-0.3, 0.3, (50, 3))
    both = rods.both_forward(q)
    for k in range(2):
        tool = Poses(both[:, k], forward_kinematics(rods, q).poses.rotation)
        assert np.abs(rods.gap(q, rods.plate_poses(tool))).max() < 1e-12
    assert_allclose(both[:, 0], forward_kinematics(robot, q).poses.position, atol=1e-14)
    other = forward_kinematics(robot, q, start=Poses(both[:, 1], forward_kinematics(rods, q).poses.rotation))
    assert_allclose(other.poses.position, both[:, 1], atol=1e-14)


def test_another_geometry_is_another_robot():
    """A rod longer by 1 mm moves the tool; the pose keeps the new rods' lengths."""
    rods = build_rods(load_robot("gantry_tau", arms="complete"))
    longer = rods.geometry["rod2a.length"]
    changed = rods.with_geometry(Parameters([longer]).with_values({longer.name: longer.value + 1e-3}))
    found = forward_kinematics(changed, rods.robot.home)
    assert np.abs(changed.gap(rods.robot.home, found.plate)).max() < 1e-13
    assert np.abs(rods.gap(rods.robot.home, found.plate)).max() == pytest.approx(1e-3, rel=0.01)


@pytest.mark.parametrize("arms", ["simplified", "complete"])
def test_reasons(arms):
    """Carts too far apart are out of reach, not-a-number is one, and neither spoils its neighbours."""
    robot = load_robot("gantry_tau", arms=arms)
    q = np.repeat(robot.home[None], 4, axis=0)
    q[1, 0] += 4.0
    q[2, 1] = np.nan
    q[3, 2] += 1e6
    found = forward_kinematics(robot, q)
    assert found.reason.tolist() == ["", "out of reach", "not a number", "out of reach"]
    assert np.isnan(found.poses.position[1:]).all() and np.isfinite(found.poses.position[0]).all()


def test_wrong_sizes_are_refused():
    """Positions of another robot are named with what is expected."""
    with raises_code("wrong_shape", "3", "1", "2"):
        forward_kinematics(load_robot("gantry_tau"), np.zeros(2))


def test_a_serial_arm_and_an_articulated_plate_go_through_the_tree():
    """H4's tool is where its closed tree has it."""
    robot = load_robot("h4")
    q = robot.home + 0.05
    found = forward_kinematics(robot, q)
    solver = LoopSolver(robot)
    closed = solver.close(q)
    import pinocchio as pin

    pin.framesForwardKinematics(robot.model, solver.data, closed)
    assert_allclose(found.poses.position[0], solver.data.oMf[robot.tool_frame].translation, atol=1e-12)
