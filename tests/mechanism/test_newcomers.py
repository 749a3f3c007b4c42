"""Five parallel robots written as a newcomer would: recognised, solved, counted, calibrated, their errors and workspace."""

from __future__ import annotations

import newcomers
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import label

from tau_dyn.calibrate import calibrate
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.kinematics.accuracy import ActuatorError, ErrorBounds, study_accuracy
from tau_dyn.kinematics.workspace import PoseRequirements, find_workspace
from tau_dyn.mechanism import TreePose, build_kinematics, build_rods

COUNTS = {"five_bar": 4, "three_rrr": 8, "three_rpr": 1, "six_pus": 64, "three_prs": 8}
"""Positions of all actuators at one pose: two an arm of two links or of a slide and a rod, one a telescopic leg."""
COMMANDED = {
    "five_bar": "x y",
    "three_rrr": "x y rz",
    "three_rpr": "x y rz",
    "six_pus": "x y z rx ry rz",
    "three_prs": "z rx ry",
}
REACH = 0.08  # [m or rad] around home


@pytest.fixture(scope="module", params=list(newcomers.ROBOTS))
def found(request):
    """Return a robot's name, kinematics, and positions around home with their poses."""
    kin = build_kinematics(newcomers.ROBOTS[request.param]())
    q = kin.robot.home + np.random.default_rng(3).uniform(-REACH, REACH, (60, kin.robot.na))
    forward = kin.forward(q)
    return request.param, kin, q[forward.ok], forward.poses.take(forward.ok)


def test_legs_put_the_tool_where_the_tree_puts_it(found):
    """Position and rotation against Newton on all joints of the tree; what one commands is what the tool can do."""
    name, kin, q, poses = found
    assert kin.legs is not None and " ".join(kin.commanded.names) == COMMANDED[name]
    assert len(q) > 50
    tree, _ = TreePose(kin.robot).forward(q)
    assert_allclose(poses.position, tree.position, atol=1e-9)
    assert_allclose(poses.rotation, tree.rotation, atol=1e-8)


def test_jacobian_is_that_of_differences(found):
    """Position rows, central differences."""
    _, kin, q, poses = found
    J, h = kin.jacobian(q[:5], poses.take(slice(0, 5))), 1e-6
    for k in range(kin.robot.na):
        step = h * np.eye(kin.robot.na)[k]
        moved = kin.forward(q[:5] + step).poses.position - kin.forward(q[:5] - step).poses.position
        assert_allclose(J[:, :3, k], moved / (2 * h), atol=1e-5 * max(1.0, np.abs(J).max()))


def test_all_solutions_are_found_close_and_differ(found):
    """As many as theory counts, proved, each closing the mechanism, no two alike, home's among them."""
    name, kin, q, poses = found
    solved = kin.solutions(poses)
    assert solved.proved.all()
    there = np.isfinite(solved.q).all(axis=2)
    assert np.median(there.sum(axis=1)) == COUNTS[name] and there.sum(axis=1).max() == COUNTS[name]
    for k in range(0, len(q), 7):
        own = solved.q[k][there[k]]
        gap = kin.closure(own, poses.take(np.full(len(own), k)))
        assert np.abs(gap).max() < 1e-9
        apart = np.abs(own[:, None] - own[None]).max(axis=2) + np.eye(len(own))
        assert apart.min() > 1e-6
        assert np.abs(own - q[k]).max(axis=1).min() < 1e-8


def test_inverse_kinematics_leads_back(found):
    """Home's configuration at the poses of positions around home."""
    _, kin, q, poses = found
    back = kin.inverse(poses, limits=False)
    assert back.ok.all()
    assert_allclose(back.q, q, atol=1e-8)


def test_two_links_an_arm_have_the_solutions_of_trigonometry():
    """A 3-RRR's shoulder angles against the law of cosines, both elbows of each arm."""
    kin = build_kinematics(newcomers.three_rrr())
    poses = kin.forward(kin.robot.home[None]).poses
    base, plate = newcomers._planar_corners()
    corners = poses.position[0, :2] + plate @ poses.rotation[0, :2, :2].T
    wanted = [
        sorted(newcomers._bend(A, B, 0.3, 0.3, s)[0] for s in (1, -1)) for A, B in zip(base, corners, strict=True)
    ]
    solved = kin.solutions(poses).q[0]
    for k in range(3):
        own = np.unique(np.round((solved[:, k] + np.pi) % (2 * np.pi) - np.pi, 9))
        assert_allclose(own, np.sort((np.array(wanted[k]) + np.pi) % (2 * np.pi) - np.pi), atol=1e-8)


def test_height_and_tilts_of_a_3_prs_are_met_and_the_rest_follows():
    """Commanded coordinates come out as asked; shifts and twist that go with tilts are reported as a position's error."""
    kin = build_kinematics(newcomers.three_prs())
    home = kin.commanded.of(kin.forward(kin.robot.home[None]).poses)
    wanted = home + np.random.default_rng(0).uniform(-1, 1, (40, 3)) * [0.1, 0.3, 0.3]
    asked = kin.commanded.to_poses(wanted)
    solved = kin.inverse(asked, limits=False)
    assert solved.ok.all()
    reached = kin.forward(solved.q).poses
    assert_allclose(kin.commanded.of(reached), wanted, atol=1e-9)
    assert_allclose(solved.position_error, np.linalg.norm(reached.position - asked.position, axis=1), atol=1e-9)
    assert solved.position_error.max() > 1e-3
    aside = asked._replace(position=asked.position + [0.1, 0, 0])
    assert (kin.inverse(aside, limits=False).reason == "out of reach").all()


def test_a_planar_plate_leaves_its_plane_for_nobody():
    """A pose above the plane is out of reach, not moved into it."""
    kin = build_kinematics(newcomers.three_rrr())
    home = kin.forward(kin.robot.home[None]).poses
    assert kin.inverse(home).ok.all()
    assert kin.inverse(home._replace(position=home.position + [0, 0, 0.01])).reason[0] == "out of reach"


@pytest.mark.parametrize("mirrored", [False, True])
def test_passive_homes_choose_the_assembly_mode(mirrored):
    """A five-bar with the same motor angles is above or below the line of its elbows, as the file's passive homes say."""
    robot = newcomers.five_bar(mirrored)
    kin = build_kinematics(robot)
    tip = kin.forward(robot.home[None]).poses.position[0]
    assert (np.linalg.norm(tip - [0.15, 0.5, 0.0]) < 1e-12) != mirrored
    closed = kin.full_positions(robot.home[None])[0]
    for name, value in robot.passive_home.items():
        assert_allclose(closed[robot.model.joints[robot.model.getJointId(name)].idx_v], value, atol=1e-9)
    assert set(robot.passive_home) == {"elbow1", "elbow2"}


@pytest.mark.parametrize("name", newcomers.ROBOTS)
def test_errors_of_drives_reach_the_tool(name):
    """Accuracy runs, and its largest error is the linear one for small errors."""
    kin = build_kinematics(newcomers.ROBOTS[name]())
    robot = kin.robot
    errors = ErrorBounds({joint: ActuatorError(1e-6) for joint in robot.actuated})
    at = kin.forward(robot.home[None]).poses
    found = study_accuracy(robot, errors, robot.home[None], at, methods=("linear", "exact"), samples=10)
    largest = found.accuracy.largest
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * robot.na)).reshape(robot.na, -1)
    wanted = np.linalg.norm(kin.jacobian(robot.home[None])[0][:3] @ (1e-6 * signs), axis=0).max()
    assert_allclose(largest["linear"], wanted, rtol=1e-6)
    assert_allclose(largest["exact"], wanted, rtol=1e-3)


@pytest.mark.parametrize("name", newcomers.ROBOTS)
def test_calibration_finds_moved_joints(name):
    """Poses of a robot with joints 1 mm off are explained to the device's noise of position and of orientation."""
    robot, rng = newcomers.ROBOTS[name](), np.random.default_rng(0)
    geometry = RodGeometry(build_rods(robot))
    theta = geometry.parameters.values.copy()
    own = [k for k, p in enumerate(geometry.parameters.names) if p.endswith(("origin_x", "origin_y"))]
    theta[own] += 1e-3 * rng.standard_normal(len(own))
    q = robot.home + rng.uniform(-REACH, REACH, (48, robot.na))
    poses = simulate_poses(geometry, theta, q, rng, noise=(1e-5, 1e-5))
    found = calibrate(robot, poses, model="complete")
    assert np.median(found.errors(found.chosen).distance) < 4e-5
    assert found.chosen.fit.converged
    assert_allclose(found.chosen.fit.noise, 1e-5, rtol=0.3)


def test_the_workspace_of_a_five_bar_is_where_both_arms_reach_on_homes_side():
    """Area against a fine grid of trigonometry: both elbows bent, drives within their travel, beyond the motors' line."""
    robot = newcomers.five_bar()
    found = find_workspace(robot, resolution=0.02, demands=PoseRequirements(ball_angle=np.pi, condition=1e9))
    step = 0.004
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-1.0, 1.3, step)] * 2))
    ok = np.ones(x.shape, bool)
    elbows = []
    u, low = newcomers.UPPER, newcomers.LOWER
    for base, sign in ((0.0, -1.0), (0.3, 1.0)):
        d = np.hypot(x - base, y)
        with np.errstate(invalid="ignore"):
            bend = sign * np.arccos((d**2 - u**2 - low**2) / (2 * u * low))
            q = np.arctan2(y, x - base) - np.arctan2(low * np.sin(bend), u + low * np.cos(bend))
            home = robot.home[len(elbows)]
            q = home + (q - home + np.pi) % (2 * np.pi) - np.pi
            ok &= np.isfinite(q) & ((np.abs(q) <= 3) | (np.abs(q - 2 * np.pi) <= 3) | (np.abs(q + 2 * np.pi) <= 3))
        elbows.append((base + u * np.cos(q), u * np.sin(q)))
    (x1, y1), (x2, y2) = elbows
    with np.errstate(invalid="ignore"):
        ok &= (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1) > 0
    shape = (round(len(x) ** 0.5),) * 2
    pieces = label(ok.reshape(shape))[0].ravel()
    area = np.sum(pieces == pieces[np.argmin(np.hypot(x - 0.15, y - 0.5))]) * step**2
    assert found.dimension == 2
    assert_allclose(found.size.value, area, rtol=0.03)
