"""The column map that is proposed for a pose file undoes its conventions, and says what a map cannot state."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent / "poses"))
from pose_rigs import l1, six_axes

from tau_dyn.calibrate import PoseSet, propose_pose_columns, read_poses
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.cli import main
from tau_dyn.mechanism import Poses, convert_to_quaternions
from tau_dyn.robot import Robot

QUATERNION = ["qx_tool", "qy_tool", "qz_tool", "qw_tool"]


def measure(robot: Robot, n: int = 50) -> PoseSet:
    """Return poses of a robot a little off its file, with speeds of its joints."""
    rng, geometry = np.random.default_rng(7), build_geometry(robot)
    q = robot.home + np.where(np.array(robot.position_units) == "rad", 1.2, 0.3) * rng.uniform(-1, 1, (n, robot.na))
    theta = geometry.parameters.values + 3e-4 * geometry.parameters.free * rng.standard_normal(len(geometry.parameters))
    tool = geometry.forward(theta, q).poses
    turn = Rotation.random(rng=rng).as_matrix()
    position = tool.position @ turn.T + [1.0, 2.0, 0.5]
    return PoseSet(q, position, turn @ tool.rotation if geometry.orients else None, speed=rng.standard_normal(q.shape))


def write(poses: PoseSet, joints: list[str], path: Path, *, quaternion: list[str] = QUATERNION) -> None:
    """Write a pose file with columns of joints' names."""
    table = pd.DataFrame(poses.q, columns=joints)
    table[[name.replace("q_", "v_") for name in joints]] = poses.speed
    table[["x_tool", "y_tool", "z_tool"]] = poses.position
    if poses.rotation is not None:
        table[quaternion] = convert_to_quaternions(Poses(poses.position, poses.rotation))
    table.to_csv(path, index=False)


def own_names(robot: Robot) -> list[str]:
    return [f"q_{joint}" for joint in robot.actuated]


def scale_joint(k: int, factor: float) -> Callable[[PoseSet], PoseSet]:
    def apply(poses: PoseSet) -> PoseSet:
        own = np.where(np.arange(poses.na) == k, factor, 1.0)
        return replace(poses, q=poses.q * own, speed=poses.speed * own)

    return apply


def exchange(a: int, b: int) -> Callable[[PoseSet], PoseSet]:
    def apply(poses: PoseSet) -> PoseSet:
        order = np.arange(poses.na)
        order[[a, b]] = b, a
        return replace(poses, q=poses.q[:, order], speed=poses.speed[:, order])

    return apply


def in_degrees(poses: PoseSet) -> PoseSet:
    return replace(poses, q=np.degrees(poses.q), speed=np.degrees(poses.speed))


SPOILED: dict[str, Callable[[PoseSet], PoseSet]] = {
    "sign": scale_joint(2, -1.0),
    "quarter turn": lambda p: replace(p, q=p.q + np.pi / 2 * (np.arange(p.na) == 3)),
    "exchanged": exchange(1, 2),
    "degrees": in_degrees,
    "degrees and a sign": lambda p: in_degrees(scale_joint(2, -1.0)(p)),
    "millimetres": lambda p: replace(p, position=1e3 * p.position),
    "axes": lambda p: replace(p, position=p.position[:, [1, 2, 0]]),
}


@pytest.mark.parametrize("name", SPOILED)
def test_the_map_undoes_what_columns_can_state(name: str, tmp_path: Path) -> None:
    """Read with the proposed map, the file holds the poses and speeds of the joints as they were."""
    robot, poses = six_axes(), measure(six_axes())
    write(SPOILED[name](poses), own_names(robot), tmp_path / "poses.csv")
    proposal = propose_pose_columns(tmp_path / "poses.csv", robot)
    assert proposal is not None and len(proposal.warnings) == 1
    read = read_poses(tmp_path / "poses.csv", robot.actuated, columns=proposal.to_map())
    assert read.rotation is not None and poses.rotation is not None
    for found, true in ((read.q, poses.q), (read.position, poses.position), (read.rotation, poses.rotation)):
        assert np.allclose(found, true, atol=1e-9)
    assert np.allclose(read.speed, poses.speed)


def test_the_order_of_a_quaternion_is_one_of_names(tmp_path: Path) -> None:
    """Columns named x y z w that hold w x y z are mapped to what they hold."""
    robot, poses = six_axes(), measure(six_axes())
    write(poses, own_names(robot), tmp_path / "poses.csv", quaternion=QUATERNION[1:] + QUATERNION[:1])
    proposal = propose_pose_columns(tmp_path / "poses.csv", robot)
    assert proposal is not None and proposal.entries["qx_tool"] == "qy_tool"
    read = read_poses(tmp_path / "poses.csv", robot.actuated, columns=proposal.to_map())
    assert np.allclose(read.rotation, poses.rotation, atol=1e-9)


def test_what_no_map_can_state_is_said(tmp_path: Path) -> None:
    """Inverse poses and shifted rows keep the plain names and a sentence; `calibrate` reads them by itself."""
    robot, poses = six_axes(), measure(six_axes())
    assert poses.rotation is not None
    back = np.swapaxes(poses.rotation, 1, 2)
    inverse = replace(poses, rotation=back, position=-np.einsum("nij,nj->ni", back, poses.position))
    later = replace(poses.take(np.arange(49)), q=poses.q[1:], speed=poses.speed[1:])
    for spoiled, words in ((inverse, "inverse"), (later, "row shift")):
        write(spoiled, own_names(robot), tmp_path / "poses.csv")
        proposal = propose_pose_columns(tmp_path / "poses.csv", robot)
        assert proposal is not None and proposal.entries["q_j1"] == "q_j1"
        assert words in proposal.warnings[1] and "no map states" in proposal.warnings[1]


def test_foreign_names_and_units_are_stated(tmp_path: Path) -> None:
    """Columns by the joints' bare names and millimetres in a name become entries with their scale; logs are left to others."""
    robot, poses = l1(), measure(l1())
    table = pd.DataFrame(poses.q, columns=list(robot.actuated))
    table[["x_mm", "y_mm", "z_mm"]] = 1e3 * poses.position
    table.to_csv(tmp_path / "poses.csv", index=False)
    proposal = propose_pose_columns(tmp_path / "poses.csv", robot)
    assert proposal is not None and proposal.entries["x_tool"] == {"column": "x_mm", "scale": 1e-3}
    assert proposal.entries["q_cart1"] == "cart1" and not proposal.warnings
    table.assign(tau_cart1=0.0).to_csv(tmp_path / "log.csv", index=False)
    assert propose_pose_columns(tmp_path / "log.csv", robot) is None


def test_the_command_writes_a_map_that_calibrate_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`columns` of a pose file asks for no clock and no torque; with its map nothing is read anew."""
    poses, file, column_map = measure(l1()), tmp_path / "poses.csv", tmp_path / "map.yaml"
    write(scale_joint(1, -1.0)(poses), own_names(l1()), file)
    assert main(["columns", str(file), "gantry_tau", "--out", str(column_map), "--quiet"]) == 0
    said = capsys.readouterr().err
    assert "sign of cart2 is reversed" in said and "clock" not in said and "torque" not in said
    assert main(["calibrate", "gantry_tau", str(file), "--columns", str(column_map), "--quiet"]) == 0
    assert "poses_reread" not in capsys.readouterr().err


def test_a_controllers_export_with_numbered_joints_is_a_pose_file(tmp_path) -> None:
    """Joints 1 to 6 and Euler angles in degrees, places without a frame's name, no clock: the map reads as the file was meant."""
    robot = six_axes()
    poses = measure(robot)
    assert poses.rotation is not None
    table = pd.DataFrame(np.degrees(poses.q), columns=[f"Axis {k}" for k in range(1, 7)])
    table[["X", "Y", "Z"]] = poses.position
    table[["A", "B", "C"]] = Rotation.from_matrix(poses.rotation).as_euler("ZYX", degrees=True)
    path = tmp_path / "export.csv"
    table.to_csv(path, index=False)
    proposal = propose_pose_columns(path, robot)
    assert proposal is not None and "Axis 1 to Axis 6" in proposal.warnings[0]
    read = read_poses(path, robot.actuated, columns=proposal.to_map())
    np.testing.assert_allclose(read.q, poses.q, atol=1e-9)
    np.testing.assert_allclose(read.position, poses.position, atol=1e-9)
    table.assign(t=0.01 * np.arange(len(table))).to_csv(path, index=False)
    assert propose_pose_columns(path, robot) is None  # a clock makes it a log


@pytest.mark.parametrize("first", ["joints", "pose"])
def test_a_table_of_poses_without_a_header_is_read_by_the_robot_file(tmp_path: Path, first: str) -> None:
    """Six angles in degrees and a position, or the position first, separated by blanks: the robot file tells which."""
    robot = six_axes()
    poses = measure(robot)
    parts = [np.degrees(poses.q), poses.position]
    path = tmp_path / "poses.txt"
    np.savetxt(path, np.hstack(parts if first == "joints" else parts[::-1]), fmt="%.9f")
    proposal = propose_pose_columns(path, robot)
    assert proposal is not None
    read = read_poses(path, robot.actuated, columns=proposal.to_map())
    np.testing.assert_allclose(read.q, poses.q, atol=1e-9)
    np.testing.assert_allclose(read.position, poses.position, atol=1e-9)


def test_nine_columns_that_no_robot_explains_are_no_pose_file(tmp_path: Path, rng) -> None:
    """A table of nine random numbers a row is not read as six joints and a position."""
    path = tmp_path / "numbers.txt"
    np.savetxt(path, rng.uniform(-1, 1, (12, 9)), fmt="%.9f")
    assert propose_pose_columns(path, six_axes()) is None


def test_a_log_without_a_header_is_no_pose_file(tmp_path: Path) -> None:
    """A controller's log begins with numbers, of which some are equal, as speeds at rest are: `columns` reads it as a log."""
    path = tmp_path / "controller.csv"
    path.write_text("838.465,0.0641,-1.5149,0.0000,0.0000\n838.475,0.0641,-1.5149,0.0000,0.0000\n")
    assert propose_pose_columns(path, l1()) is None
