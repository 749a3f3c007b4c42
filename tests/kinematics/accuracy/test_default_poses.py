"""Where `accuracy` looks without being told: a section that the robot reaches, for every robot that comes along."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.kinematics.accuracy import (
    Section,
    choose_default_section,
    lay_default_grid,
    sample_default_motion,
    section,
)
from tau_dyn.kinematics.accuracy.section import ENOUGH_POINTS
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import list_robot_names, load_robot

VARIANTS = [
    ("gantry_tau", {"arms": "complete"}),
    ("gantry_tau", {"prototype": "l2"}),
    ("gantry_tau", {"prototype": "d1", "arms": "complete"}),
    ("gantry_tau", {"prototype": "t1"}),
    ("gantry_tau", {"wrist": "serial2", "wrist_moves": "true"}),
    ("gantry_tau_queensland", {"dof": "5"}),
    ("gantry_tau_queensland", {"telescopic": "true"}),
    ("delta", {"arms": "simplified"}),
    ("triglide", {"arms": "simplified"}),
]
PLANAR = """<robot name="planar">
<link name="base_link"/><link name="a_link"/><link name="b_link"/><link name="tool"/>
<joint name="first" type="revolute"><parent link="base_link"/><child link="a_link"/><axis xyz="0 0 1"/>
<limit lower="-0.5" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="second" type="revolute"><origin xyz="0.4 0 0"/><parent link="a_link"/><child link="b_link"/><axis xyz="0 0 1"/>
<limit lower="0.2" upper="2" effort="1" velocity="1"/></joint>
<joint name="tool_fixed" type="fixed"><origin xyz="0.3 0 0"/><parent link="b_link"/><child link="tool"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("name", "given"), [*((name, {}) for name in list_robot_names()), *VARIANTS], ids=lambda value: str(value)
)
def test_every_robot_reaches_its_default_section(name: str, given: dict[str, str]) -> None:
    """The section holds ten reached points or more, at which the rods close on the plane; one actuator gives its whole motion."""
    robot = load_robot(name, **given)
    if robot.na == 1:
        sampled = sample_default_motion(robot, 7)
        assert sampled is not None and len(sampled[0]) == 7
        assert (sampled[0][0, 0], sampled[0][-1, 0]) == (robot.lower[0], robot.upper[0])
        return
    assert sample_default_motion(robot, 7) is None
    grid = lay_default_grid(robot, 9)
    assert grid.ok.sum() >= ENOUGH_POINTS
    found = forward_kinematics(robot, grid.q[grid.ok], start=grid.poses.take(grid.ok))
    np.testing.assert_allclose(found.poses.position[:, grid.section.axis], grid.section.value, atol=1e-7)
    inside = (grid.q[grid.ok] >= robot.lower - 1e-9) & (grid.q[grid.ok] <= robot.upper + 1e-9)
    assert inside.all()


def test_a_planar_arm_is_cut_along_its_plane(tmp_path) -> None:
    """Two turns about z move the tool in z = 0; a cut across y would hold a line of it."""
    file = tmp_path / "planar.urdf"
    file.write_text(PLANAR)
    robot = load_robot(file)
    section = choose_default_section(robot)
    assert (section.axis, section.value) == (2, 0.0)


def test_two_turns_that_cross_sweep_a_sphere(tmp_path) -> None:
    """A pan and tilt unit keeps its tool on a sphere, which a plane cuts in a curve: its motion is sampled instead."""
    file = tmp_path / "pan_tilt.urdf"
    file.write_text(
        PLANAR.replace('xyz="0.4 0 0"', 'xyz="0 0 0.4"').replace("0 0 1", "0 1 0").replace("0 1 0", "0 0 1", 1)
    )
    robot = load_robot(file)
    sampled = sample_default_motion(robot, 31)
    assert sampled is not None and len(sampled[0]) == 36
    distance = np.linalg.norm(sampled[1].position - [0, 0, 0.4], axis=1)
    np.testing.assert_allclose(distance, 0.3, atol=1e-12)
    assert np.ptp(sampled[0], axis=0).tolist() == (robot.upper - robot.lower).tolist()


def test_another_section_is_taken_where_the_first_is_hardly_reached(tmp_path, monkeypatch) -> None:
    """Cut across y, the planar arm gives a line of at most nine points; the plane of its motion gives more."""
    file = tmp_path / "planar.urdf"
    file.write_text(PLANAR)
    robot = load_robot(file)
    tool = forward_kinematics(robot, robot.home[None]).poses
    monkeypatch.setattr(section, "choose_default_section", lambda *_: Section(1, float(tool.position[0, 1])))
    grid = lay_default_grid(robot, 9)
    assert grid.section.axis == 2 and grid.ok.sum() > 9


def test_a_slide_is_looked_for_along_its_travel(tmp_path) -> None:
    """A slide of 3 m under a turn takes the grid farther than the sum of the links' lengths."""
    file = tmp_path / "slide.urdf"
    text = PLANAR.replace('name="first" type="revolute"', 'name="first" type="prismatic"').replace("0 0 1", "1 0 0", 1)
    file.write_text(text.replace('lower="-0.5" upper="1.5"', 'lower="-1.5" upper="1.5"'))
    robot = load_robot(file)
    grid = lay_default_grid(robot, 31)
    assert grid.section.axis == 2 and np.ptp(grid.u) > 2.5
