"""What becomes of a tree's numbers: every one is checked, ranges without an end have no middle, parameters reach the bodies."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.robot import INERTIAL, LinkInertia, Robot, load_robot_from_urdf


def with_attributes(urdf: str, tag: str, attributes: str) -> str:
    """Return the text with the first element of this tag holding these attributes alone."""
    changed, n = re.subn(rf"<{tag} [^>]*/>", f"<{tag} {attributes}/>", urdf, count=1)
    assert n == 1
    return changed


@pytest.mark.parametrize(
    ("tag", "good", "bad"),
    [
        ("limit", "", "lower"), ("limit", "", "upper"), ("limit", "", "velocity"), ("limit", "", "effort"),
        ("limit", 'lower="-1" upper="1" velocity="1"', "effort"), ("origin", "", "rpy"), ("origin", 'xyz="0 0 1"', "rpy"),
        ("inertia", 'ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"', "izz"), ("inertia", 'ixx="1" ixy="0" ixz="0" iyy="1"', "iyz"),
    ],
)  # fmt: skip
def test_a_bad_number_is_found_behind_absent_and_good_ones(write, tag: str, good: str, bad: str) -> None:
    """What may be left out is no reason to look no further."""
    urdf = with_attributes(write.pendulum(), tag, f'{good} {bad}="nan"')
    with raises_code("robot_structure", f"<{tag}", f"{bad}='nan'>"):
        load_robot_from_urdf(urdf, "pendulum")


@pytest.mark.parametrize(
    ("limits", "home"),
    [('lower="-1" upper="2"', 0.5), ('lower="1" upper="4"', 2.5), ('lower="2e9" upper="4e9"', 3e9),
     ('lower="-1" upper="1e12"', 0.0), ('lower="-1e12" upper="5"', 0.0), ('lower="-1e11" upper="1e11"', 0.0),
     ('lower="-1e300" upper="1e300"', 0.0)],
)  # fmt: skip
def test_a_range_without_an_end_has_no_middle(write, limits: str, home: float) -> None:
    """Beyond 1e10 a limit says that there is none: the home is zero then, and not half of a number that means nothing."""
    urdf = with_attributes(write.block(), "limit", f'{limits} velocity="1" effort="1"')
    robot = load_robot_from_urdf(urdf, "block")
    assert_allclose(robot.home, [home])
    lower, upper = (float(x) for x in re.findall(r'"([^"]*)"', limits))
    assert robot.lower == [lower if abs(lower) < 1e10 else -np.inf]
    assert robot.upper == [upper if abs(upper) < 1e10 else np.inf]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((("</robot>", '<link name="rod_link"/></robot>'),), "link 'rod_link' is not unique"),
        ((('type="revolute"', 'type="screw"'),), "Joint [pivot] has no known type [screw]"),
        ((('<child link="rod_link"/>', '<child link="no_link"/>'),), "child link [no_link] of joint [pivot] not found"),
    ],
)  # fmt: skip
def test_a_tree_that_cannot_be_built_is_said_in_the_parsers_words(write, changes, words: str) -> None:
    """It names the culprit on stderr alone; what it throws says nothing."""
    urdf = write.pendulum()
    for old, new in changes:
        assert old in urdf
        urdf = urdf.replace(old, new)
    with raises_code("robot_structure", "pendulum.urdf", words) as fault:
        load_robot_from_urdf(urdf, "pendulum.urdf")
    assert "Error" not in str(fault.value) and " at line " not in str(fault.value)


def test_a_link_of_two_joints_is_refused(write) -> None:
    """Who closes a loop by a second joint gets told how; the parser would build the first joint twice."""
    second = write.joint("second", "revolute", "base_link", "rod_link")
    with raises_code("robot_structure", "rod_link", "ball_constraint"):
        load_robot_from_urdf(write.pendulum().replace("</robot>", second + "</robot>"), "twice")


@pytest.mark.parametrize("ring", [("a_link",), ("a_link", "b_link"), ("a_link", "b_link", "c_link")])
def test_links_that_hang_on_themselves_are_refused(write, ring: tuple[str, ...]) -> None:
    """Beside a good tree the parser would forget them, seven kilograms each, in silence."""
    links = [write.link(name, 7, "0 0 0", "1 1 1") for name in ring]
    joints = [
        write.joint(f"to_{child}", "revolute", parent, child)
        for parent, child in zip(ring, (*ring[1:], ring[0]), strict=True)
    ]
    with pytest.raises(InputError, match="link '._link' hangs on itself, by " + ", ".join(["to_._link"] * len(ring))):
        load_robot_from_urdf(write.pendulum().replace("</robot>", "".join(links + joints) + "</robot>"), "ring")
    tail = write.link("tail_link", 1, "0 0 0", "1 1 1") + write.joint("tail", "fixed", ring[0], "tail_link")
    with raises_code("robot_structure"):
        load_robot_from_urdf(
            write.pendulum().replace("</robot>", "".join([tail, *joints, *links]) + "</robot>"), "ring"
        )


def inertial(robot: Robot, index: int, **values: float) -> np.ndarray:
    """Return the ten numbers of a body in Pinocchio's model after changes to its link's parameters."""
    link = robot.links[index]
    named = {f"{link.link}.{key}": x for key, x in values.items()}
    return robot.model_with(robot.parameters.with_values(named)).inertias[link.joint_id].toDynamicParameters()


@pytest.mark.parametrize("mass", [4.0, 1e-3, 0.0, -0.7])
def test_a_link_carries_what_its_parameters_say(two_link, mass: float) -> None:
    """All ten numbers, also of a mass that a fit without bounds puts below nothing; the other link keeps its own."""
    values = {key: 0.0 for key in INERTIAL} | {
        "mass": mass,
        "ixx": 0.3,
        "ixy": -0.01,
        "iyy": 0.2,
        "iyz": 0.02,
        "izz": 0.1,
    }
    assert_allclose(inertial(two_link, 1, **values), [values[key] for key in INERTIAL], atol=1e-15)
    if mass:
        off = values | {"mx": 0.2, "my": -0.1, "mz": 0.05}
        assert_allclose(inertial(two_link, 1, **off), [off[key] for key in INERTIAL], rtol=1e-9, atol=1e-12)
    assert_allclose(inertial(two_link, 0), two_link.links[0].nominal, rtol=1e-12)


def test_what_is_no_parameter_scales_with_the_mass() -> None:
    """Twice the mass, twice the rest; a link of its own first moment alone keeps that; one of no nominal mass has nothing."""
    nominal = np.arange(1.0, 11.0)
    link = LinkInertia("rod_link", 1, nominal, (0,))
    assert_allclose(link.map @ [2.0], 2 * nominal)
    own = LinkInertia("rod_link", 1, nominal, (0, 2))
    assert own.names == ("rod_link.mass", "rod_link.my")
    assert_allclose(own.map @ [2.0, 7.0], np.where(np.arange(10) == 2, 7.0, 2 * nominal))
    empty = LinkInertia("rod_link", 1, np.zeros(10), (0,))
    assert_allclose(empty.map @ [2.0], [2.0, *np.zeros(9)])


def test_drive_inertia_stands_at_its_joint(two_link) -> None:
    """Whatever the order of names."""
    model = two_link.model_with(two_link.parameters.with_values({"elbow.armature": 0.7, "shoulder.armature": 0.2}))
    assert_allclose(model.armature, [0.2, 0.7])
    assert not two_link.model.armature.any()
