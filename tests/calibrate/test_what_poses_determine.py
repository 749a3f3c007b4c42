"""Calibration compares and confirms what poses determine: frames, holes, campaigns, and laws with signs that machines have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet, calibrate
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.models import Spec, get_family
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot_from_urdf

NOISE = (2e-5, 6e-5)


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return an arm of six turning joints with a mass of 4 kg at each link."""
    rows = ['<robot name="six"><link name="l0_link"/>']
    places = ("0 0 0.4", "0.05 0 0", "0.4 0 0.05", "0.3 0.05 0", "0.1 0 0.05", "0 0.08 0.1")
    turns = ("0 0 0", "1.5 0.1 0", "0.1 0.2 0", "0.2 1.4 0", "1.4 0 0.3", "-1.3 0.2 0")
    for k, (xyz, rpy) in enumerate(zip(places, turns, strict=True)):
        rows.append(
            f'<link name="l{k + 1}_link"><inertial><origin xyz="0.15 0 0"/><mass value="4"/>'
            '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="j{k + 1}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{k}_link"/><child link="l{k + 1}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="90"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.1 0.02 0.05"/>')
    return load_robot_from_urdf("".join(rows) + '<parent link="l6_link"/><child link="tool"/></joint></robot>', "six")


def build_arm(robot: Robot, seed: int, size: float = 2e-3) -> tuple[TreeGeometry, np.ndarray]:
    """Return the arm's geometry and the parameters of one that is built off its file [m, rad]."""
    arm = build_tree_geometry(robot)
    rng = np.random.default_rng(seed)
    return arm, arm.parameters.values + size * rng.standard_normal(len(arm.parameters)) * arm.parameters.free


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_frame_that_training_poses_leave_open_is_not_said_to_have_moved(robot, seed: int):
    """Poses that turn one joint leave the others' dimensions open; the error elsewhere is theirs, not the device's."""
    (arm, theta), rng = build_arm(robot, seed, 6e-3), np.random.default_rng(seed)
    q = np.tile(rng.uniform(-0.5, 0.5, 6), (14, 1))
    q[:, 0] += np.linspace(-0.3, 0.3, 14)
    train = simulate_poses(arm, theta, q, rng, noise=NOISE)
    held = simulate_poses(arm, theta, rng.uniform(-1, 1, (30, 6)), rng, noise=NOISE)
    found = calibrate(robot, train, held)
    assert not [f for f in found.findings if f.cause.endswith("_moved")]
    assert "frame_undetermined" in map(get_code, found.warnings)
    assert found.errors(found.chosen).position_size.rms > 100 * NOISE[0]


def test_a_device_that_moved_by_a_little_is_named_after_full_training(robot):
    """0.3 mm between training and held-out poses, both all over the workspace."""
    (arm, theta), rng = build_arm(robot, 3), np.random.default_rng(3)
    train = simulate_poses(arm, theta, rng.uniform(-1, 1, (50, 6)), rng, noise=NOISE)
    held = simulate_poses(arm, theta, rng.uniform(-1, 1, (30, 6)), rng, noise=NOISE)
    held.position[:] += [3e-4, 0, 0]
    found = calibrate(robot, train, held, model="complete")
    assert [(f.cause, f.status) for f in found.findings if f.cause.endswith("_moved")] == [
        ("device_moved", "confirmed")
    ]


def test_a_campaign_of_one_joint_is_placed_by_the_other_campaigns(robot):
    """Two devices 3 m apart; the first saw one joint turn. Any order of the rows gives the accuracy of the noise, to 1e-6."""
    (arm, theta), rng = build_arm(robot, 5, 5e-4), np.random.default_rng(5)
    places = Rotation.from_rotvec(rng.normal(size=(3, 3))).as_matrix()
    device = tuple(Frame(turn, rng.uniform(-3, 3, 3)) for turn in places[:2])
    frames = DeviceFrames(device, (Frame(places[2], np.array([0.02, -0.05, 0.1])),) * 2)
    q, campaign = rng.uniform(-1, 1, (80, 6)), np.repeat([0, 1], 40)
    q[:40, np.array([0, 1, 2, 4, 5])] = 0.1
    poses = simulate_poses(arm, theta, q, rng, frames=frames, noise=NOISE, campaign=campaign)
    one = replace(frames, device=device[:1], tool=frames.tool[:1])
    held = simulate_poses(arm, theta, rng.uniform(-1, 1, (30, 6)), rng, frames=one, noise=NOISE)
    found = [calibrate(robot, poses.take(order), held) for order in (np.arange(80), rng.permutation(80))]
    errors = [one.errors(one.chosen).position_size.rms for one in found]
    assert errors[0] == pytest.approx(errors[1], rel=1e-6) and errors[0] < 1.3 * np.sqrt(3) * NOISE[0]
    assert [one.chosen.name for one in found] == ["complete+base_frame"] * 2


def test_positions_alone_are_compared_where_training_has_no_orientation(robot):
    """Held-out poses with orientations after training without: the target's own orientation is unknown."""
    (arm, theta), rng = build_arm(robot, 4), np.random.default_rng(4)
    train = simulate_poses(arm, theta, rng.uniform(-1, 1, (40, 6)), rng, noise=NOISE, turned=False)
    held = simulate_poses(arm, theta, rng.uniform(-1, 1, (20, 6)), rng, noise=NOISE)
    found = calibrate(robot, train, held, model="complete")
    assert "orientation_unused" in map(get_code, found.warnings) and found.errors(found.chosen).rotation is None
    assert found.errors(found.chosen).position_size.rms < 5 * NOISE[0]
    assert calibrate(robot, held, train, model="frames").errors is not None


def test_joints_that_stand_still_cannot_answer(robot):
    """The same joint positions in every row show no dimension."""
    rng = np.random.default_rng(5)
    poses = PoseSet(np.tile(np.full(6, 0.3), (20, 1)), rng.standard_normal((20, 3)))
    with raises_code("poor_excitation", "same positions"):
        calibrate(robot, poses)


def touch(arm: TreeGeometry, theta: np.ndarray, point: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return joint positions (6,) at which a tip 0.12 m ahead of the tool is at a point, in an attitude at random."""
    tip = np.array([0.02, 0.01, 0.12])

    def gap(q: np.ndarray) -> np.ndarray:
        at = arm.forward(theta, q[None]).poses
        return at.position[0] + at.rotation[0] @ tip - point

    while True:
        first = rng.uniform(-1.2, 1.2, 6)
        near = least_squares(lambda q, x=first: np.r_[gap(q), 1e-4 * (q - x)], first).x
        found = least_squares(lambda q, x=near: np.r_[gap(q), 1e-9 * (q - x)], near)
        if np.linalg.norm(gap(found.x)) < 1e-7 and np.abs(found.x).max() < 2.8:
            return found.x


def test_a_tip_held_in_two_holes_calibrates_the_arm(robot):
    """All positions lie in a line; the attitudes show the dimensions. The error elsewhere is the truth's, in free space."""
    (arm, theta), rng = build_arm(robot, 6), np.random.default_rng(6)
    centre = arm.forward(theta, np.zeros((1, 6))).poses.position[0] + [-0.1, 0, 0.1]
    holes = [np.array([0.0, 0, 0]), np.array([0.05, 0, 0])]
    q = np.array([touch(arm, theta, centre + hole, rng) for hole in holes for _ in range(25)])
    position = np.repeat(holes, 25, axis=0)
    found = calibrate(robot, PoseSet(q + 1e-5 * rng.standard_normal(q.shape), position), model="complete")
    assert found.errors(found.chosen).position_size.rms < 1e-4


@pytest.mark.parametrize("first", [0, 1])
def test_a_campaign_at_another_place_is_kept_whichever_is_on_top(robot, first: int):
    """Twenty poses on a line, seen from another place, are no outliers of forty in space, on top of the file or below."""
    (arm, theta), rng = build_arm(robot, 7), np.random.default_rng(7)
    one = simulate_poses(arm, theta, rng.uniform(-1, 1, (40, 6)), rng, noise=NOISE)
    line = np.tile([0.2, 0.3, -0.4, 0.1, 0.3, 0.2], (20, 1)) + np.linspace(-0.4, 0.4, 20)[:, None] * [
        0,
        1,
        -1.5,
        0.5,
        0,
        0,
    ]
    two = simulate_poses(arm, theta, line, rng, noise=NOISE)
    parts = [(one.q, one.position), (two.q, two.position @ np.array([[0, 1, 0], [0, 0, 1], [1.0, 0, 0]]) + [2, 1, 0])]
    parts = parts if first == 0 else parts[::-1]
    poses = PoseSet(
        np.concatenate([q for q, _ in parts]),
        np.concatenate([p for _, p in parts]),
        campaign=np.repeat([0, 1], [len(q) for q, _ in parts]),
        campaigns=("a", "b"),
    )
    found = calibrate(robot, poses)
    assert found.holdout is not None and found.poses.n + found.holdout.n == 60
    assert found.errors(found.chosen).position_size.rms < 5 * NOISE[0]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_joint_that_rises_against_gravity_is_not_said_to_yield(robot, sign: int):
    """4e-5 rad/(N m) at j2: named with its size where the joint sinks; where it rises, rejected with that size as the reason."""
    rng = np.random.default_rng(8)
    q = rng.uniform(-1.2, 1.2, (110, 6))
    family = get_family(robot, PoseSet(q, np.zeros((110, 3))))
    geometry = family.build(Spec("complete", {"gravity": ("j2",)}))
    theta = geometry.parameters.values.copy()
    theta[geometry.parameters.names.index("j2.gravity_compliance")] = sign * 4e-5
    poses = simulate_poses(geometry, theta, q, rng, noise=NOISE)
    found = calibrate(robot, poses.take(np.arange(70)), poses.take(np.arange(70, 110)))
    gravity = {f.joints: f for f in found.findings if f.cause == "gravity_deflection"}
    assert [joints for joints, f in gravity.items() if f.status == "confirmed"] == ([("j2",)] if sign > 0 else [])
    if sign < 0:
        assert "j2.gravity_compliance = -" in gravity["j2",].why_not_confirmed
        assert (
            gravity["j2",].to_dict()["detection_limit"] is None and "j2.gravity_compliance" not in found.fit.parameters
        )
    else:
        assert found.fit.parameters["j2.gravity_compliance"].value == pytest.approx(4e-5, rel=0.3)
