"""Robot files at fault, and hostile ones: each is refused in one sentence that names the place."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import expand, load_robot, load_robot_from_urdf

XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}<link name="base_link"/></robot>'
BOMB = '<!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><robot name="r"><link name="&b;"/></robot>'


@pytest.fixture
def refused(tmp_path):
    """Return a function that loads a file of this content and gives the sentence of refusal."""

    def load(content: str, name: str = "r.urdf.xacro", **arguments: object) -> str:
        path = tmp_path / name
        path.write_text(content)
        with raises_code("file_format") as fault:
            load_robot(path, **arguments)
        sentence = str(fault.value)
        assert "\n" not in sentence and fault.value.exit_status == 2
        return sentence

    return load


def test_an_unknown_xacro_argument_lists_the_declared_ones() -> None:
    """A misspelt argument would otherwise be ignored in silence."""
    with raises_code("unknown_name", "rod_mass_model"):
        load_robot("gantry_tau", prototyp="l2")


def test_an_unknown_value_says_which_there_are() -> None:
    """The robot file itself knows its prototypes."""
    with raises_code("file_format", "l1", "l2", "d1", "t1", "x9"):
        load_robot("gantry_tau", prototype="x9")


def test_an_unknown_short_name_lists_the_known_ones() -> None:
    """A bare word is a short name."""
    with raises_code("unknown_name", "gantry_two", "gantry_tau", "gantry_tau_f1"):
        load_robot("gantry_two")


def test_without_the_stock_robots_their_package_is_named(monkeypatch) -> None:
    """Where the package of stock arms is not installed, the sentence says how to get it."""
    monkeypatch.setattr(expand, "list_stock_robots", dict)
    with pytest.raises(UnknownName, match="pip install example-robot-data"):
        load_robot("ur5")


def test_of_many_names_the_nearest_come_first() -> None:
    """A slip in a name is answered by the names that resemble it, capitals aside."""
    known = [f"robot_{k}" for k in range(40)] + ["panda", "ur5"]
    assert "there are robot_0, robot_1, " in str(UnknownName("robot", "x", known))
    assert "there are ur5, " in str(UnknownName("robot", "UR55", known))
    assert "(did you mean panda?)" in str(UnknownName("robot", "Panda", known))


def test_files_that_are_absent_or_no_robot_files(tmp_path: Path) -> None:
    """The path is named; a log given in the robot's place is noticed by its suffix."""
    with raises_code("file_not_found", "absent.urdf"):
        load_robot(tmp_path / "absent.urdf")
    (tmp_path / "log.csv").write_text("t,q_axis\n")
    with raises_code("file_format", "log.csv", ".urdf.xacro"):
        load_robot(tmp_path / "log.csv")


def test_entities_are_refused(refused) -> None:
    """A document type can expand without end or read files."""
    assert "may not declare a document type" in refused(BOMB)


def test_a_robot_takes_no_parameters_of_another(write) -> None:
    """Values are put in by name; another robot's are refused, its own go in."""
    one, other = load_robot_from_urdf(write.pendulum(), "one"), load_robot_from_urdf(write.two_link(), "other")
    assert one.with_parameters(one.parameters).parameters.names == one.parameters.names
    with raises_code("unknown_name", "parameter"):
        one.with_parameters(other.parameters)


@pytest.mark.parametrize("inner", [BOMB, '<!DOCTYPE robot><robot name="r"/>'])
def test_entities_are_refused_in_an_included_file_too(refused, tmp_path: Path, inner: str) -> None:
    """What xacro includes it parses by itself, but our way, and the message names that file."""
    (tmp_path / "inner.xacro").write_text(inner)
    sentence = refused(XACRO.format('<xacro:include filename="inner.xacro"/>'))
    assert "inner.xacro" in sentence and "document type" in sentence


def test_broken_xml_is_refused_with_its_line(refused) -> None:
    """File and line of the fault."""
    assert "r.urdf.xacro, line 3: not well-formed XML" in refused('<robot name="r">\n<link name="base_link"/>\n</robt>')


def test_an_undeclared_prefix_gets_a_hint(refused) -> None:
    """The commonest slip when loops are added to a plain URDF."""
    assert "xmlns:drake" in refused('<robot name="r"><drake:ball_constraint/></robot>')


def test_an_undefined_property_is_named(refused) -> None:
    """The words of xacro follow the file's name."""
    sentence = refused(XACRO.format('<link name="${lenght}"/>'))
    assert "r.urdf.xacro: xacro cannot expand it" in sentence and "lenght" in sentence


@pytest.mark.parametrize("code", ["__import__('os').getpid()", "().__class__.__bases__", "open('/etc/passwd').read()"])
def test_python_expressions_reach_neither_imports_nor_files(refused, code: str) -> None:
    """An expression may compute a length; it may not import, open a file or climb to a class."""
    assert "xacro cannot expand it" in refused(XACRO.format(f'<link name="${{{code}}}"/>'))


def test_endless_recursion_ends_in_a_sentence(refused) -> None:
    """A macro that calls itself without end."""
    macro = '<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>'
    assert "r.urdf.xacro" in refused(XACRO.format(macro))


def test_a_name_for_both_a_link_and_a_joint_is_refused(write) -> None:
    """Parameters are named after links and joints; Drake and MuJoCo also mix them up."""
    urdf = write.pendulum().replace("rod_link", "pivot")
    with raises_code("robot_structure", "_link"):
        load_robot_from_urdf(urdf, "twins")


def test_loops_without_transmissions_ask_for_actuated_joints(write) -> None:
    """Which joints of a loop are driven cannot be guessed."""
    with raises_code("robot_structure", "<transmission>", "--actuated"):
        load_robot_from_urdf(write.four_bar(driven=""), "bars")


def test_unknown_actuated_joints_are_named(write) -> None:
    """So are fixed joints, which do not move."""
    with raises_code("unknown_name"):
        load_robot_from_urdf(write.four_bar(), "bars", actuated=["crnk"])


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('body_A name="coupler_link"', 'body_A name="nobody_link"', "names link 'nobody_link'; there are base_link"),
        ('<drake:ball_constraint_body_B name="rocker_link"/>', "", "lacks <drake:ball_constraint_body_B>"),
        ('p_AP value="0.9 0 0"', 'p_AP value="0.9 nan 0"', "must hold 3 finite"),
        ('p_AP value="0.9 0 0"', 'p_AP value="0.9 0"', "must hold 3 finite"),
        ('p_AP value="0.9 0 0"', 'p_AP value="0.9 0 zero"', "must hold 3 finite"),
        ('<joint name="crank"/>', '<joint name="krank"/>', "names joint 'krank'; there are crank, coupler, rocker"),
        ("</robot>", '<tau_dyn:home joint="crank" value="inf"/></robot>', "must hold 1 finite"),
        ("</robot>", '<tau_dyn:link name="no_link" parameters="mass"/></robot>', "names link 'no_link'"),
    ],
)  # fmt: skip
def test_faulty_annotations_name_the_element(write, old: str, new: str, sentence: str) -> None:
    """Each element that we read beyond plain URDF is checked, and the message says what exists."""
    urdf = write.four_bar()
    assert old in urdf
    with pytest.raises(InputError, match=sentence):
        load_robot_from_urdf(urdf.replace(old, new), "bars")


def test_motors_of_joints_that_the_file_lacks_are_left_out(write) -> None:
    """A file of one arm of a robot keeps the motors of the others; a name that is nearly one of its own is a slip."""
    urdf = write.four_bar()
    robot = load_robot_from_urdf(
        urdf.replace("</robot>", '<transmission name="t"><joint name="left_hip"/></transmission></robot>'), "bars"
    )
    assert robot.actuated == load_robot_from_urdf(urdf, "bars").actuated
    assert any("left_hip" in warning for warning in robot.warnings)


def test_friction_below_zero_is_refused(write) -> None:
    """An identification without bounds writes negative friction; it would feed energy."""
    urdf = write.pendulum().replace("</joint>", '<dynamics damping="0.1" friction="-0.39"/></joint>', 1)
    with raises_code("robot_structure", "pivot", "-0.39"):
        load_robot_from_urdf(urdf, "rod")


@pytest.mark.parametrize(
    ("attribute", "place"),
    [("mass value", "link 'rod_link'"), ("inertia ixx", "link 'rod_link'"), ("origin xyz", "link 'rod_link'"),
     ("axis xyz", "joint 'pivot'"), ("limit lower", "joint 'pivot'")],
)  # fmt: skip
@pytest.mark.parametrize("value", ["nan", "inf", "heavy", ""])
def test_numbers_of_the_tree_must_be_finite(write, attribute: str, place: str, value: str) -> None:
    """The URDF parser drops a link's whole inertia over one bad number and goes on; we name the place."""
    urdf, n = re.subn(f'<{attribute}="[^"]*"', f'<{attribute}="{value}"', write.pendulum(), count=1)
    assert n == 1
    with raises_code("robot_structure", f"{place}", f"<{attribute}='{value}'>"):
        load_robot_from_urdf(urdf, "pendulum")


@pytest.mark.parametrize(
    ("element", "sentence"),
    [(r"<mass[^>]*/>", "lacks <mass>"), (r"<inertia [^>]*/>", "lacks <inertia>"), (' izz="[^"]*"', "<inertia izz=''>")],
)
def test_an_incomplete_inertia_is_refused_not_dropped(write, element: str, sentence: str) -> None:
    """Without it the link would weigh nothing, in silence."""
    urdf, n = re.subn(element, "", write.pendulum(), count=1)
    assert n == 1
    with raises_code("robot_structure", "rod_link", f"{sentence}"):
        load_robot_from_urdf(urdf, "pendulum")


@pytest.mark.parametrize("mass", [-2.0, -0.01])
def test_a_negative_mass_is_refused(write, mass: float) -> None:
    """A mass is not negative, not even by grams."""
    with raises_code("robot_structure", "rod_link", f"{mass}"):
        load_robot_from_urdf(write.pendulum(mass), "pendulum")


@pytest.mark.parametrize(
    "urdf",
    ["", "no xml", "<robot/>", "<sdf/>", '<robot name="r"/>', '<robot name="r"><link name="base_link"/></robot>',
     '<robot name="r"><link/></robot>', '<robot name="r"><joint name="j" type="revolute"/></robot>'],
)  # fmt: skip
def test_texts_that_are_no_robot_are_refused(urdf: str) -> None:
    """Whatever comes, the fault is ours to name, never a traceback of a parser."""
    with raises_code("robot_structure"):
        load_robot_from_urdf(urdf, "text")


def test_floating_and_planar_joints_cannot_be_actuated(write) -> None:
    """An actuated joint has one position and one force."""
    urdf = write.text(
        "f", write.link("a_link", 1), write.joint("a", "floating", "base_link", "a_link"), write.drive("a")
    )
    with raises_code("robot_structure"):
        load_robot_from_urdf(urdf, "floating")
