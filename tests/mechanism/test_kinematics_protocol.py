"""One interface for every mechanism: derivatives of its closure against differences, commanded coordinates, other dimensions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import Poses, build_kinematics, build_mechanism, convert_from_quaternions
from tau_dyn.robot import load_robot, load_robot_from_urdf

KINDS = {
    "sliding plate": ("gantry_tau", {}),
    "free plate": ("gantry_tau", {"arms": "complete"}),
    "six legs": ("stewart", {}),
    "five freedoms": ("gantry_tau_5dof", {}),
    "tree": ("parallelogram", {}),
    "articulated plate": ("h4", {}),
}


def _kinematics(kind: str):
    name, arguments = KINDS[kind]
    return build_kinematics(load_robot(name, **arguments))


def _moved(poses: Poses, twist: np.ndarray) -> Poses:
    """Return poses after a small twist (6,)."""
    turned = convert_from_quaternions(np.zeros((1, 3)), np.array([[*twist[3:] / 2, 1.0]])).rotation[0]
    return Poses(poses.position + twist[:3], turned @ poses.rotation)


@pytest.mark.parametrize("kind", KINDS)
def test_closure_is_zero_at_forward_kinematics_and_its_derivatives_are_those_of_differences(kind, rng):
    """`g(q, FK(q)) = 0`; `G_x`, `G_q` and `G_p` against central differences."""
    kin = _kinematics(kind)
    q = kin.robot.home + rng.uniform(-0.05, 0.05, (3, kin.robot.na))
    poses, h = kin.forward(q).poses, 1e-6
    assert_allclose(kin.closure(q, poses), 0.0, atol=1e-9)
    for k in range(kin.closure_by_pose(q).shape[2]):
        step = h * np.eye(6)[k]
        found = (kin.closure(q, _moved(poses, step)) - kin.closure(q, _moved(poses, -step))) / (2 * h)
        assert_allclose(kin.closure_by_pose(q, poses)[:, :, k], found, atol=1e-6)
    for k in range(kin.robot.na):
        step = h * np.eye(kin.robot.na)[k]
        found = (kin.closure(q + step, poses) - kin.closure(q - step, poses)) / (2 * h)
        assert_allclose(kin.closure_by_q(q, poses)[:, :, k], found, atol=1e-6)
    rows = kin.closure_by_geometry(q, poses)
    for k in rng.choice(len(kin.geometry), 5, replace=False):
        p = list(kin.geometry)[k]
        sides = [kin.with_geometry(kin.geometry.select([p.name]).with_values(np.array([p.value + s]))) for s in (h, -h)]
        found = (sides[0].closure(q, poses) - sides[1].closure(q, poses)) / (2 * h)
        assert_allclose(rows[:, :, k], found, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_pose_by_geometry_is_how_forward_kinematics_move_with_a_dimension(kind, rng):
    """One dimension at a time, by central differences of the tool's place."""
    kin = _kinematics(kind)
    q, h = kin.robot.home + rng.uniform(-0.05, 0.05, (3, kin.robot.na)), 1e-6
    columns = kin.pose_by_geometry(q)
    for k in rng.choice(len(kin.geometry), 4, replace=False):
        p = list(kin.geometry)[k]
        sides = [kin.with_geometry(kin.geometry.select([p.name]).with_values(np.array([p.value + s]))) for s in (h, -h)]
        found = (sides[0].forward(q).poses.position - sides[1].forward(q).poses.position) / (2 * h)
        assert_allclose(columns[:, :3, k], found, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_all_joints_follow_the_actuated_ones(kind):
    """Full positions hold the actuated ones, and are those of one mechanism for kinematics and dynamics."""
    kin = _kinematics(kind)
    q = kin.robot.home[None] + 0.01
    assert_allclose(kin.full_positions(q)[:, kin.robot.active_v], q)
    assert build_mechanism(kin.robot).kinematics is kin


COMMANDED = {
    "gantry_tau": "x y z",
    "delta": "x y z",
    "stewart": "x y z rx ry rz",
    "h4": "x y z rz",
    "linear_axis": "x",
}


@pytest.mark.parametrize("name", COMMANDED)
def test_commanded_coordinates_are_the_freedoms_of_the_tool_at_home(name, rng):
    """Their names; poses from them give them back, and what is not commanded is home's."""
    kin = build_kinematics(load_robot(name))
    assert " ".join(kin.commanded.names) == COMMANDED[name]
    values = kin.commanded.of(kin.forward(kin.robot.home[None]).poses) + rng.uniform(
        -0.2, 0.2, (4, len(COMMANDED[name].split()))
    )
    assert_allclose(kin.commanded.of(kin.commanded.to_poses(values)), values, atol=1e-12)
    assert kin.commanded.units == tuple("m" if n in "xyz" else "rad" for n in kin.commanded.names)


def _arm(*joints: str) -> str:
    """Return a serial arm; each word is kind, axis and length to the next joint along x and z: `turn:0 0 1:0.3 0.2`."""
    parts, parent = ['<robot name="arm"><link name="world"/>'], "world"
    for k, word in enumerate(joints):
        kind, axis, place = word.split(":")
        x, z = place.split()
        parts.append(
            f'<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="l{k}"/><axis xyz="{axis}"/>'
            f'<origin xyz="{x} 0 {z}"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint><link name="l{k}"><inertial>'
            f'<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<transmission name="t{k}"><joint name="j{k}"/></transmission>'
        )
        parent = f"l{k}"
    parts.append(
        f'<joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool"/><origin xyz="0.2 0 0"/></joint>'
    )
    return "".join([*parts, '<link name="tool"/></robot>'])


ARMS = {
    "six turns": (
        ("revolute:0 0 1:0 0.3", "revolute:0 1 0:0.1 0.2", "revolute:0 1 0:0.1 0.4", "revolute:1 0 0:0.3 0",
         "revolute:0 1 0:0.2 0.1", "revolute:0 0 1:0.1 0.1"),
        "x y z rx ry rz",
    ),
    "scara": (("revolute:0 0 1:0 0.3", "revolute:0 0 1:0.4 0", "prismatic:0 0 1:0.3 0", "revolute:0 0 1:0 0"), "x y z rz"),
    "planar arm of three turns": (("revolute:0 0 1:0 0", "revolute:0 0 1:0.4 0", "revolute:0 0 1:0.3 0"), "x y rz"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARMS)
def test_serial_arms_command_what_they_can_move(name):
    """A serial arm by its tool's twists at home, bent by 0.4 rad so that it is not straight."""
    joints, wanted = ARMS[name]
    text = _arm(*joints).replace(
        "</robot>",
        "".join(f'<tau_dyn:home xmlns:tau_dyn="urn:tau_dyn" joint="j{k}" value="0.4"/>' for k in range(len(joints)))
        + "</robot>",
    )
    assert " ".join(build_kinematics(load_robot_from_urdf(text, "arm")).commanded.names) == wanted


def test_inverse_kinematics_of_a_changed_tree_are_refused():
    """What is not answered says so."""
    kin = _kinematics("tree")
    changed = kin.with_geometry(kin.geometry)
    poses = changed.forward(kin.robot.home[None]).poses
    with raises_code("unsupported"):
        changed.inverse(poses)
