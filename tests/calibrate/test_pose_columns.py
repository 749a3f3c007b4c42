"""Poses with foreign columns, coupled encoders, and joints that follow others in the robot file."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.calibrate import read_poses
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot_from_urdf, read_annotations

URDF = """<robot name="two"><link name="base_link"/><link name="a_link"/><link name="b_link"/>
<joint name="a" type="revolute"><parent link="base_link"/><child link="a_link"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="b" type="revolute"><origin xyz="0.4 0 0"/><parent link="a_link"/><child link="b_link"/><axis xyz="0 1 0"/>
<mimic joint="a" {more}/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint></robot>"""


def test_a_joint_that_follows_another_needs_no_column(tmp_path):
    """A link kept level by a parallelogram turns back by what the arm turns, and starts at an angle of its own."""
    (tmp_path / "poses.csv").write_text("q_a,x_tool,y_tool,z_tool\n0.5,1,2,3\n-0.2,1,2,3\n")
    notes = read_annotations(URDF.format(more='multiplier="-1" offset="0.3"'), "two")
    poses = read_poses(tmp_path / "poses.csv", ("a", "b"), mimics=notes.mimics)
    assert poses.q == pytest.approx(np.array([[0.5, -0.2], [-0.2, 0.5]]))
    with raises_code("missing_column", "q_b"):
        read_poses(tmp_path / "poses.csv", ("a", "b"))
    plain = read_annotations(URDF.format(more=""), "two").mimics["b"]
    assert (plain.joint, plain.multiplier, plain.offset) == ("a", 1.0, 0.0)
    robot = load_robot_from_urdf(URDF.format(more=""), "two")
    assert (robot.actuated, robot.mimics["b"].joint) == (("a",), "a")


def test_a_mimic_of_a_joint_that_is_not_there_is_refused():
    """The joint that another one follows has to exist."""
    with raises_code("robot_structure", "nowhere"):
        read_annotations(URDF.format(more="").replace('joint="a"', 'joint="nowhere"'), "two")


def test_a_map_renames_scales_and_undoes_couplings(tmp_path):
    """Degrees and millimetres under foreign names, the second encoder measured against the ground."""
    (tmp_path / "poses.csv").write_text("A1,A2,X,Y,Z\n90,30,100,200,300\n")
    (tmp_path / "map.yaml").write_text(
        "q_a: {column: A1, scale: 0.017453292519943295}\nq_b: {column: A2, scale: 0.017453292519943295}\n"
        "x_tool: {column: X, scale: 0.001}\ny_tool: {column: Y, scale: 0.001}\nz_tool: {column: Z, scale: 0.001}\n"
        "couplings: {q: [[1.0, 0.0], [-1.0, 1.0]]}\n"
    )
    poses = read_poses(tmp_path / "poses.csv", ("a", "b"), columns=tmp_path / "map.yaml")
    assert poses.q == pytest.approx(np.deg2rad([[90.0, -60.0]])) and poses.position == pytest.approx(
        np.array([[0.1, 0.2, 0.3]])
    )
    (tmp_path / "map.yaml").write_text("q_a: {column: A1, file: other}\nfiles: {other: other.csv}\n")
    with raises_code("unsupported", "one file"):
        read_poses(tmp_path / "poses.csv", ("a", "b"), columns=tmp_path / "map.yaml")


def test_a_standard_error_of_zero_is_a_scatter_below_the_last_digit(tmp_path):
    """A tracker writes micrometres: a scatter of 0.4 um is written as 0 and weighs like the smallest that was written."""
    path, header = tmp_path / "poses.csv", "q_a,x_tool,y_tool,z_tool,x_tool_stderr,y_tool_stderr,z_tool_stderr\n"
    path.write_text(header + "0.5,1,2,3,0,2e-6,0\n-0.2,1,2,3,3e-6,4e-6,2e-6\n0.1,1,2,3,1e-6,5e-6,7e-6\n")
    poses = read_poses(path, ("a",))
    assert poses.position_stderr is not None
    assert poses.position_stderr[0] == pytest.approx([1e-6, 2e-6, 2e-6]) and poses.position_stderr.min() == 1e-6
    assert [get_code(w) for w in poses.warnings] == ["stderr_rounded"]
    assert (
        "2 standard errors are zero" in poses.warnings[0]
        and "x_tool_stderr 1e-06, z_tool_stderr 2e-06" in poses.warnings[0]
    )


@pytest.mark.parametrize("rows", ["0.5,1,2,3,0,0,0\n-0.2,1,2,3,0,0,0\n", "0.5,1,2,3,0,1,1\n-0.2,1,2,3,-1e-6,1,1\n"])
def test_standard_errors_that_are_none_are_refused(tmp_path, rows: str):
    """A column without any number above zero says nothing, and no scatter is negative."""
    header = "q_a,x_tool,y_tool,z_tool,x_tool_stderr,y_tool_stderr,z_tool_stderr\n"
    (tmp_path / "poses.csv").write_text(header + rows)
    with raises_code("bad_sample", "must be above zero"):
        read_poses(tmp_path / "poses.csv", ("a",))
