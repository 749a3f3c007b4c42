"""The thesis' implicit kinematics, (4.26) forward and (4.25) inverse, agrees with the general solvers."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism import Poses, build_rods, forward_kinematics, inverse_kinematics
from tau_dyn.robot import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from thesis_4_parts.parallel_rods import solve_implicit_forward, solve_implicit_inverse


def moved(robot, rng, n: int = 100, size: float = 0.1) -> np.ndarray:
    """Return positions (n, na) about home, joint plates 2 and 3 turned by opposite angles."""
    q = robot.home + rng.uniform(-size, size, (n, robot.na))
    if "q4" in robot.actuated:
        q[:, robot.actuated.index("q5")] = -q[:, robot.actuated.index("q4")]
    return q


@pytest.mark.parametrize(("name", "given"), [("gantry_tau_t2", {}), ("gantry_tau", {"arms": "complete"})])
def test_closed_form_equals_newton(name, given, rng) -> None:
    """At q4 = -q5 the closed form gives the positions that Newton's method finds, and those that the pose came from, to 1e-10."""
    robot = load_robot(name, **given)
    rods, q = build_rods(robot), moved(robot, rng)
    found = forward_kinematics(robot, q)
    closed, newton = solve_implicit_inverse(rods, found.poses), inverse_kinematics(robot, found.poses, limits=False)
    assert found.ok.all() and newton.ok.all() and closed.defect.max() < 1e-12
    assert_allclose(closed.q, newton.q, atol=1e-10)
    assert_allclose(closed.q, q, atol=1e-10)
    assert_allclose(solve_implicit_forward(rods, closed.q).poses.position, found.poses.position, atol=1e-10)


def test_all_eight_configurations_hold_the_rods(rng) -> None:
    """Each cart has two places on its guideway: 2^3 = 8 solutions (thesis 4.2), all with the rods' lengths, home's by default."""
    robot = load_robot("gantry_tau_t2")
    rods = build_rods(robot)
    pose = forward_kinematics(robot, moved(robot, rng, 1)).poses
    every = [solve_implicit_inverse(rods, pose, configuration=c).q[0] for c in product((-1, 1), repeat=3)]
    plate = rods.plate_poses(pose)
    assert len(np.unique(np.round(every, 6), axis=0)) == 8
    assert max(np.abs(rods.gap(q[None], plate)).max() for q in every) < 1e-12
    assert np.abs(np.array(every) - solve_implicit_inverse(rods, pose).q).max(axis=1).min() == 0.0


def test_configurations_have_the_names_of_the_inverse(rng) -> None:
    """A configuration's signs mean the same here as in `inverse_kinematics`."""
    robot = load_robot("gantry_tau", arms="complete")
    rods, pose = build_rods(robot), forward_kinematics(robot, moved(robot, rng, 5)).poses
    for signs in product((-1, 1), repeat=3):
        closed = solve_implicit_inverse(rods, pose, configuration=signs).q
        assert_allclose(closed, inverse_kinematics(robot, pose, configuration=signs, limits=False).q, atol=1e-10)


def test_frames_of_the_carts_are_free(rng) -> None:
    """Turning a cart's frame, with all that hangs on it turned back, is the same robot: the same positions follow."""
    robot = load_robot("gantry_tau_t2")
    rods, joints = build_rods(robot), []
    P = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    parents = [joint.parent for joint in rods.numbers.joints]
    for k, joint in enumerate(rods.numbers.joints):
        if joint.slides and k in parents:
            joints.append(joint._replace(rotation=joint.rotation @ P))
        elif joint.parent >= 0 and rods.numbers.joints[joint.parent].slides:
            back = {"origin": P.T @ joint.origin, "direction": P.T @ joint.direction, "rotation": P.T @ joint.rotation}
            joints.append(joint._replace(**back))
        else:
            joints.append(joint)
    turned = replace(rods, numbers=replace(rods.numbers, joints=tuple(joints)))
    q = moved(robot, rng, 20)
    assert_allclose(turned.base_points(q), rods.base_points(q), atol=1e-14)
    assert_allclose(solve_implicit_inverse(turned, forward_kinematics(robot, q).poses).q, q, atol=1e-10)


def test_the_sixth_freedom_shows_as_a_defect(rng) -> None:
    """The arms cannot follow a turn orthogonal to both joint plates' axes: the vectors differ by its angle times their length."""
    robot = load_robot("gantry_tau_t2")
    rods = build_rods(robot)
    pose = forward_kinematics(robot, robot.home[None]).poses
    tilts = [Rotation.from_rotvec(0.05 * e).as_matrix() @ pose.rotation for e in np.eye(3)]
    defects = [solve_implicit_inverse(rods, Poses(pose.position, R)).defect[0] for R in tilts]
    assert sorted(d > 1e-3 for d in defects) == [False, False, True] and sorted(defects)[1] < 1e-12
    calibrated = load_robot("gantry_tau_f1")
    q = moved(calibrated, rng, 20)
    closed = solve_implicit_inverse(build_rods(calibrated), forward_kinematics(calibrated, q).poses)
    assert closed.defect.min() > 1e-4


def test_out_of_reach_and_other_robots() -> None:
    """A pose beyond the rods has no positions; arms that turn, six legs and unknown configurations are refused."""
    robot = load_robot("gantry_tau", arms="complete")
    rods = build_rods(robot)
    pose = forward_kinematics(robot, robot.home[None]).poses
    far = Poses(pose.position + np.array([0.0, 0.0, 9.0]), pose.rotation)
    assert np.isnan(solve_implicit_inverse(rods, far).q).all()
    with raises_code("invalid_value"):
        solve_implicit_inverse(rods, pose, configuration=(1, 0, 1))
    for name in ("delta", "stewart"):
        with raises_code("unsupported"):
            solve_implicit_inverse(build_rods(load_robot(name)), pose)


@pytest.mark.parametrize(
    ("name", "arguments"), [("gantry_tau", {"arms": "complete"}), ("delta", {}), ("gantry_tau_t2", {})]
)
def test_closed_form_of_parallel_rods_equals_newton(name, arguments, rng) -> None:
    """The thesis' implicit kinematics (4.26): with q4 = -q5 rotation and position of the T2 come one after the other."""
    robot = load_robot(name, **arguments)
    q = moved(robot, rng, 50, 0.08)
    found, closed = forward_kinematics(robot, q), solve_implicit_forward(build_rods(robot), q)
    assert found.ok.all() and closed.defect.max() < 1e-12
    assert_allclose(closed.poses.position, found.poses.position, atol=1e-11)
    assert_allclose(closed.poses.rotation, found.poses.rotation, atol=1e-11)


def test_closed_form_says_where_it_is_not_exact() -> None:
    """With q4 and q5 apart the arms' vectors are no rotated plate: the defect shows it, Newton solves it."""
    robot = load_robot("gantry_tau_t2")
    q = robot.home.copy()
    q[robot.actuated.index("q4")] += 0.1
    closed, found = solve_implicit_forward(build_rods(robot), q), forward_kinematics(robot, q)
    assert closed.defect[0] > 1e-3 and found.ok[0]
    assert np.abs(build_rods(robot).gap(q, found.plate)).max() < 1e-13
