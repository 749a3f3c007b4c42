"""Loops in a YAML file next to a URDF, as example-parallel-robots writes them, close as those in the URDF do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.robot import Robot, load_robot

BODY = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINTS = (
    # name, parent, child, origin
    ("mot1", "base", "crank1", "0 0 0"),
    ("free1", "crank1", "rod1", "0.3 0 0.1"),
    ("mot2", "base", "crank2", "0.4 0 0"),
    ("free2", "crank2", "rod2", "0.3 0 0.1"),
    ("free3", "rod2", "end", "0 0 -0.6"),
)
"""A five-bar about y with a hinge at the end of its second rod; the rods' ends meet below the cranks' ends."""
TIES = "closed_loop: [[tip1, tip2]]\ntype: [{kind}]\nname_mot: [mot1, mot2]\n"


def write(folder: Path, loops: str) -> Path:
    """Return a five-bar's URDF without a word on loops or motors, with a YAML file next to it."""
    links = "".join(
        f'<link name="{name}">{BODY}</link>' for name in ("base", "crank1", "rod1", "crank2", "rod2", "end")
    )
    hinges = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        '<axis xyz="0 1 0"/><limit effort="1" velocity="20"/></joint>'
        for name, parent, child, xyz in JOINTS
    )
    tips = "".join(
        f'<link name="{tip}"/><joint name="{tip}_frame" type="fixed"><parent link="{link}"/><child link="{tip}"/>'
        f'<origin xyz="{xyz}"/></joint>'
        for tip, link, xyz in (("tip1", "rod1", "0 0 -0.6"), ("tip2", "end", "0 0 0"))
    )
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="five_bar">{links}{hinges}{tips}</robot>')
    path.with_suffix(".yaml").write_text(loops)
    return path


def close(robot: Robot) -> tuple[float, int]:
    """Return the gap at home [m], and how many passive motions are left free."""
    solver = LoopSolver(robot)
    return solver.closure_error(solver.close(robot.home)), solver.free_motions().shape[1]


@pytest.mark.parametrize(("kind", "free"), [("3d", 1), ("6d", 0)])
def test_origins_meet_or_axes_too(tmp_path: Path, kind: str, free: int) -> None:
    """Frames whose origins meet leave the hinge at the end free; frames whose axes meet do not."""
    robot = load_robot(write(tmp_path, TIES.format(kind=kind)))
    assert robot.actuated == ("mot1", "mot2") and not robot.home.any()
    gap, left = close(robot)
    assert gap < 1e-10 and left == free


def test_a_frame_may_be_a_joint(tmp_path: Path) -> None:
    """The frame of a joint is that of its child link."""
    named = load_robot(write(tmp_path, TIES.format(kind="3d").replace("tip2", "free3")))
    assert close(named)[0] < 1e-10 and named.loops[0].name == "tip1-end"


def test_joints_drawn_as_hinges_are_what_the_file_says(tmp_path: Path) -> None:
    """A ball joint is three hinges about x, y, z, a universal joint two, and a fixed joint does not move."""
    for kind, more in (("SPHERICAL", 2), ("UJOINT_ZY", 1), ("FIXED", -1)):
        robot = load_robot(write(tmp_path, f"{TIES.format(kind='3d')}joint_name: [free3]\njoint_type: [{kind}]\n"))
        assert robot.model.nv == len(JOINTS) + more
        axes = [n for n in robot.model.names if n.startswith("free3")]
        assert axes == {2: ["free3_x", "free3_y", "free3"], 1: ["free3_z", "free3"], -1: []}[more]
        assert np.isfinite(close(robot)[0])


@pytest.mark.parametrize(
    ("loops", "words"),
    [
        (TIES.format(kind="5d"), "a loop of type 5d"),
        (TIES.format(kind="3d") + "spring: [mot1]\n", "spring is not read"),
        (TIES.format(kind="3d, 3d"), "closed_loop has 1 entries, type has 2"),
        ("closed_loop: [tip1]\ntype: [3d]\n", "list of pairs"),
        (TIES.format(kind="3d") + "joint_name: [free3]\njoint_type: [SCREW]\n", "a joint of type SCREW"),
    ],
)
def test_what_is_not_understood_is_refused(tmp_path: Path, loops: str, words: str) -> None:
    """Nothing is dropped: a loop that is not closed makes another robot."""
    with pytest.raises(InputError, match=words):
        load_robot(write(tmp_path, loops))


def test_an_unknown_frame_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="tip9"):
        load_robot(write(tmp_path, TIES.format(kind="3d").replace("tip2", "tip9")))


def test_other_yaml_files_are_not_read(tmp_path: Path) -> None:
    """A model file of the same name lists no loops, and the tree stays a tree."""
    assert not load_robot(write(tmp_path, "parameters: []\n")).loops
