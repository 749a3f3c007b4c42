"""Robot files as geometries: derivatives and placements against finite differences and Pinocchio, loops closed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.mechanism import Poses
from tau_dyn.robot import load_robot, load_robot_from_urdf

URDF = Path(__file__).resolve().parents[2] / "urdf"

SIX = """<robot name="six">
<link name="base_link"/>
<link name="foot_link"/><joint name="foot" type="fixed"><origin xyz="0.1 0 0.05" rpy="0 0 0.4"/>
<parent link="base_link"/><child link="foot_link"/></joint>
{joints}
<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0 0.02 0.1" rpy="0.3 0 0"/>
<parent link="l6_link"/><child link="tool"/></joint>
</robot>"""
PLACES = [
    ("0 0 0.3", "0 0 0", "0 0 1"),
    ("0.1 0 0.1", "1.5707963 0 0", "0 0 1"),
    ("0.5 0 0", "0 0 0", "0 0 1"),
    ("0.05 0 0.1", "0 1.5707963 0", "0 0.6 0.8"),
    ("0 0 0.4", "-1.5707963 0 0", "0 0 1"),
    ("0 0.08 0", "1.5707963 0 0", "0 0 1"),
]


def six_axes(slide: int | None = None) -> str:
    """Return a 6R arm with two parallel axes, an oblique one and a fixed joint below the first; one may slide instead."""
    rows = []
    for k, (xyz, rpy, axis) in enumerate(PLACES, start=1):
        parent = "foot_link" if k == 1 else f"l{k - 1}_link"
        kind = "prismatic" if k == slide else "revolute"
        rows.append(
            f'<link name="l{k}_link"/><joint name="j{k}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="{parent}"/><child link="l{k}_link"/><axis xyz="{axis}"/>'
            '<limit lower="-2.5" upper="2.5" velocity="2" effort="50"/></joint>'
        )
    return SIX.format(joints="".join(rows))


def differences(geometry: TreeGeometry, theta: np.ndarray, q: np.ndarray, step: float = 1e-6) -> tuple:
    """Return tool twists per parameter and per joint by central differences."""

    def twist(a: Poses, b: Poses) -> np.ndarray:
        turn = Rotation.from_matrix(a.rotation @ np.swapaxes(b.rotation, 1, 2)).as_rotvec()
        return np.concatenate([a.position - b.position, turn], axis=1) / (2 * step)

    def at(dt: np.ndarray, dq: np.ndarray) -> Poses:
        return geometry.forward(theta + dt, q + dq).poses

    p, n = np.eye(len(theta)) * step, np.eye(q.shape[1]) * step
    zero_t, zero_q = np.zeros(len(theta)), np.zeros(q.shape[1])
    by_parameter = np.stack([twist(at(d, zero_q), at(-d, zero_q)) for d in p], axis=2)
    by_joint = np.stack([twist(at(zero_t, d), at(zero_t, -d)) for d in n], axis=2)
    return by_parameter, by_joint


@pytest.mark.parametrize("slide", [None, 3, 4])
def test_serial_derivatives(slide: int | None) -> None:
    """Twists of all placements, offsets and gear ratios of a serial arm are those of finite differences, far from nominal."""
    robot = load_robot_from_urdf(six_axes(slide), "six")
    geometry, rng = build_tree_geometry(robot), np.random.default_rng(3)
    theta = geometry.parameters.values + rng.normal(0, 0.05, len(geometry.knobs))
    q = rng.uniform(-1, 1, (4, 6))
    by_parameter, by_joint = differences(geometry, theta, q)
    assert np.abs(geometry.tool_by_parameter(theta, q) - by_parameter).max() < 1e-8
    assert np.abs(geometry.tool_by_joint(theta, q) - by_joint).max() < 1e-8


def test_serial_against_pinocchio() -> None:
    """The tool is where Pinocchio puts it when its joint placements are moved by the same numbers."""
    robot = load_robot_from_urdf(six_axes(), "six")
    geometry, rng = build_tree_geometry(robot), np.random.default_rng(4)
    p = geometry.parameters
    changes = {n: float(rng.normal(0, 0.03)) for n in p.names if ".tool" not in n and not n.startswith("tool.")}
    theta = np.array([row.value + changes.get(row.name, 0.0) for row in p])
    model = robot.model.copy()
    for k in range(1, 7):
        within = geometry.shape.within[k - 1]
        shift = np.array([changes[f"j{k}.origin_{a}"] for a in "xyz"])
        turn = np.array([changes[f"j{k}.r{a}"] for a in "xyz"])
        placement = model.jointPlacements[k]
        model.jointPlacements[k] = pin.SE3(
            placement.rotation @ pin.exp3(turn), placement.translation + within.rotation @ shift
        )
    q = rng.uniform(-1.5, 1.5, (5, 6))
    found = geometry.forward(theta, q)
    data, frame = model.createData(), model.getFrameId("tool")
    for k in range(len(q)):
        gain = np.array([theta[p.names.index(f"j{j}.gain")] for j in range(1, 7)])
        offset = np.array([theta[p.names.index(f"j{j}.offset")] for j in range(1, 7)])
        pin.framesForwardKinematics(model, data, gain * q[k] + offset)
        assert np.abs(found.poses.position[k] - data.oMf[frame].translation).max() < 1e-12
        assert np.abs(found.poses.rotation[k] - data.oMf[frame].rotation).max() < 1e-12


def test_nominal_values_are_the_files() -> None:
    """An origin's value is the number in the file, also where a fixed joint lies between the links."""
    p = build_tree_geometry(load_robot_from_urdf(six_axes(), "six")).parameters
    for k, (xyz, _, _) in enumerate(PLACES, start=1):
        assert np.allclose([p[f"j{k}.origin_{a}"].value for a in "xyz"], [float(x) for x in xyz.split()])


@pytest.mark.parametrize("name", ["delta", "h4", "stewart", "parallelogram"])
def test_loops(name: str) -> None:
    """With all dimensions 1 mm off, loops close to rounding, and derivatives through them are finite differences'."""
    robot = load_robot(URDF / f"{name}.urdf.xacro")
    geometry, rng = build_tree_geometry(robot), np.random.default_rng(5)
    free = np.array(geometry.parameters.free)
    theta = geometry.parameters.values + rng.normal(0, 1e-3, len(free)) * free
    reach = np.minimum(np.where(np.isfinite(robot.upper), 0.2 * (robot.upper - robot.lower), 0.2), 0.2)
    q = robot.home + rng.uniform(-1, 1, (3, robot.na)) * reach
    found = geometry.forward(theta, q)
    assert found.ok.all()
    if name == "parallelogram":
        assert 1e-5 < geometry.left_open(theta, q).max() < 0.02  # across the plane nothing can close it
    else:
        assert geometry.left_open(theta, q).max() < 1e-12
    some = geometry.only([n for n, f in zip(geometry.parameters.names, free, strict=True) if f][::6])
    values = theta[[geometry.parameters.names.index(n) for n in some.parameters.names]]
    by_parameter, by_joint = differences(some, values, q)
    assert np.abs(some.tool_by_parameter(values, q) - by_parameter).max() < 1e-7
    assert np.abs(some.tool_by_joint(values, q) - by_joint).max() < 1e-7


def test_delta_has_the_papers_parameters() -> None:
    """A Delta's free parameters are the paper's 51 (20) and its actuators' places, which (13) merges into others."""
    geometry = build_tree_geometry(load_robot(URDF / "delta.urdf.xacro"))
    free = {p.name for p in geometry.parameters if p.free}
    bases = {f"arm{i}.origin_{a}" for i in (1, 2, 3) for a in "xyz"}
    assert len(free) == 60 and bases <= free
    assert all(f"rod{i}{j}.length" in free for i in (1, 2, 3) for j in "ab")


def test_planar_loop_ignores_what_lies_across() -> None:
    """Of a planar loop only what lies in its plane reaches the tool: rod 2's place across it does not, the crank's does."""
    geometry = build_tree_geometry(load_robot(URDF / "parallelogram.urdf.xacro"))
    assert geometry.tree.loops.over_constrained == 1
    p = geometry.parameters
    assert not p["rod2_turn.origin_y"].free and not p["rod2_turn.rx"].free and p["crank.origin_y"].free


def test_out_of_reach_is_said() -> None:
    """Positions that the loops cannot follow come back as nan with a reason, the others unharmed."""
    robot = load_robot(URDF / "stewart.urdf.xacro")
    geometry = build_tree_geometry(robot)
    q = np.stack([robot.home, robot.home + [0.9, -0.3, 0.9, -0.3, 0.9, -0.3]])
    found = geometry.forward(geometry.parameters.values, q)
    assert found.ok.tolist() == [True, False] and found.reason[1]
    assert np.isnan(found.poses.position[1]).all() and np.isfinite(found.poses.position[0]).all()
    assert np.isfinite(geometry.tool_by_parameter(geometry.parameters.values, q)[0]).all()


def test_impossible_geometry_is_said() -> None:
    """Rods too short to reach the plate are no closure."""
    geometry = build_tree_geometry(load_robot(URDF / "delta.urdf.xacro"))
    theta = geometry.parameters.values.copy()
    for i in (1, 2, 3):
        for j in "ab":
            theta[geometry.parameters.names.index(f"rod{i}{j}.length")] = 0.1
    found = geometry.forward(theta, geometry.home)
    assert not found.ok[0] and found.reason[0]


def test_order_of_calls_changes_nothing() -> None:
    """A closure depends on its own numbers, not on the geometry asked for before, but for rounding."""
    robot = load_robot(URDF / "delta.urdf.xacro")
    one, two = build_tree_geometry(robot), build_tree_geometry(robot)
    q, theta = robot.home[None] + 0.1, one.parameters.values
    far = theta + 2e-3 * np.array(one.parameters.free)
    two.forward(far, q)
    a, b = one.forward(theta, q).poses.position, two.forward(theta, q).poses.position
    assert np.abs(a - b).max() < 1e-13


def test_tool_is_asked_for() -> None:
    """A robot with two tips and no frame `tool` is refused with the frames it has; an unknown frame likewise."""
    two = six_axes().replace('name="tool"', 'name="tip_link"').replace('link="tool"', 'link="tip_link"')
    assert build_tree_geometry(load_robot_from_urdf(two, "two")).shape.tool.link == "tip_link"
    branch = (
        '<link name="l7_link"/><joint name="j7" type="revolute"><parent link="l3_link"/><child link="l7_link"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    with raises_code("unsupported", "l7_link"):
        build_tree_geometry(load_robot_from_urdf(two.replace("</robot>", branch), "two"))
    with raises_code("unknown_name", "nowhere"):
        build_tree_geometry(load_robot_from_urdf(six_axes(), "six"), tool="nowhere")


def test_wrong_arrays_are_refused() -> None:
    """Arrays of the wrong length name what is expected."""
    geometry = build_tree_geometry(load_robot_from_urdf(six_axes(), "six"))
    with raises_code("wrong_shape", "6"):
        geometry.forward(geometry.parameters.values, np.zeros((2, 5)))
    with raises_code("wrong_shape", "parameters"):
        geometry.forward(np.zeros(3), np.zeros((2, 6)))
