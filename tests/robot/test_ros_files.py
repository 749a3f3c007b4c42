"""Robot files as ROS writes them: packages, controllers, couplings, friction, proposed loops, SRDF, meshes that are not there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import build_model
from tau_dyn.mechanism import build_mechanism, forward_kinematics
from tau_dyn.robot import find_package, find_robot, list_stock_robots, load_robot, load_robot_from_urdf, resolve_mesh

XACRO = (
    '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    '<xacro:include filename="$(find arm_description)/urdf/arm.xacro"/></robot>'
)


@pytest.fixture
def workspace(tmp_path, write):
    """Return a workspace with the package `arm_description` in a folder of another name, and a file that asks for it."""
    package = tmp_path / "src" / "arm_ros"
    (package / "urdf").mkdir(parents=True)
    (package / "package.xml").write_text("<package><name> arm_description </name></package>")
    (package / "urdf" / "arm.xacro").write_text(write.two_link())
    (package / "arm.stl").write_text("")
    (package / "urdf" / "robot.urdf.xacro").write_text(XACRO)
    elsewhere = tmp_path / "elsewhere" / "deep" / "robot.urdf.xacro"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text(XACRO)
    return package, elsewhere


def test_a_package_is_found_around_the_file_by_variables_and_by_hand(workspace, monkeypatch):
    """`$(find ..)` and `package://` need no ROS; what is nowhere is named with the remedy."""
    package, elsewhere = workspace
    assert load_robot(package / "urdf" / "robot.urdf.xacro").na == 2
    with raises_code("file_not_found", "arm_description", "--package arm_description=DIR"):
        load_robot(elsewhere)
    assert load_robot(elsewhere, packages={"arm_description": package}).na == 2
    with raises_code("file_not_found", "/nowhere"):
        load_robot(elsewhere, packages={"arm_description": "/nowhere"})
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent.parent))
    assert find_package("arm_description", elsewhere) == package
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    installed = elsewhere.parent / "share" / "arm_description"
    installed.mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(elsewhere.parent))
    assert find_package("arm_description", elsewhere) == installed
    assert resolve_mesh("package://arm_description/arm.stl", package / "urdf" / "x.urdf") == package / "arm.stl"
    assert resolve_mesh("package://nobody/arm.stl", elsewhere) is None


def test_a_missing_mesh_costs_nothing(write, tmp_path):
    """Shapes are for the eye."""
    mesh = '<visual><geometry><mesh filename="package://nobody/arm.stl"/></geometry></visual>'
    path = tmp_path / "r.urdf"
    path.write_text(
        write.two_link().replace(
            '<link name="upper_link">', f'<link name="upper_link">{mesh}{mesh.replace("visual", "collision")}'
        )
    )
    assert load_robot(path).parameters["upper_link.mass"].value == 3


def test_plain_urdf_loads_without_xacro(write, tmp_path):
    """Start-up pays for what is used."""
    path = tmp_path / "r.urdf"
    path.write_text(write.two_link())
    code = (
        f"import sys; from tau_dyn.robot import load_robot; load_robot({str(path)!r}); "
        "print({'xacro', 'tau_dyn.robot._restricted_xacro'} & set(sys.modules))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert said.stdout.split() == ["set()"]


def test_ros2_control_names_the_motors(write):
    """A joint with a command interface is actuated; one that is only read is not."""
    control = (
        '<ros2_control name="c" type="system"><joint name="shoulder"><command_interface name="effort"/></joint>'
        '<joint name="elbow"><state_interface name="position"/></joint></ros2_control></robot>'
    )
    plain = write.two_link().replace(write.drive("shoulder") + write.drive("elbow"), "")
    assert load_robot_from_urdf(plain.replace("</robot>", control), "arm").actuated == ("shoulder",)


def follow(write, more: str = "") -> str:
    """Return two links of which the second follows the first at -0.5 times its angle and 0.2 rad."""
    elbow, rule = '<joint name="elbow" type="revolute">', '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'
    return write.two_link().replace(elbow, elbow + rule + more)


def test_a_mimicked_joint_adds_its_force_by_virtual_work(write):
    """`tau = tau_1 + k tau_2` at `q_2 = k q_1 + c`, armature and friction included by `k^2` and `|k|`."""
    text = follow(write, '<dynamics damping="4" friction="3"/>')
    text = text.replace(write.drive("elbow"), write.drive("elbow", '<drake:rotor_inertia value="0.8"/>'))
    robot, free = load_robot_from_urdf(text, "coupled"), load_robot_from_urdf(write.two_link(), "free")
    assert robot.actuated == ("shoulder",) and list(robot.mimics) == ["elbow"]
    q, v, a = np.random.default_rng(0).normal(size=(3, 40, 1))
    both = [np.hstack([x, -0.5 * x + c]) for x, c in ((q, 0.2), (v, 0.0), (a, 0.0))]
    tau = build_mechanism(free).inverse_dynamics(*both)
    wanted = tau[:, :1] - 0.5 * tau[:, 1:] + 0.25 * 0.8 * a
    for part in (slice(None), slice(3)):  # many samples at once, and few
        found = build_mechanism(robot).inverse_dynamics(q[part], v[part], a[part])
        assert_allclose(found, wanted[part], atol=1e-12)
        M, h = build_mechanism(robot).mass_and_bias(q[0], v[0])
        assert_allclose(M @ a[0] + h, wanted[0], atol=1e-12)
    assert (robot.friction["shoulder"].viscous, robot.friction["shoulder"].coulomb) == (1.0, 1.5)
    where = forward_kinematics(robot, q).poses.position
    model, data = free.model, free.model.createData()
    pin.framesForwardKinematics(model, data, both[0][0])
    assert_allclose(where[0], data.oMf[model.getFrameId(robot.tool)].translation, atol=1e-12)


def test_a_follower_limits_its_leader(write):
    """`low <= k q + c <= high` and `|k v| <= speed` hold for the follower, so they bound position and speed of the leader."""
    limit = '<limit lower="-1" upper="1" effort="50" velocity="0.6"/>'
    text = re.sub(r'(<joint name="elbow".*?)<limit[^>]*/>', rf"\1{limit}", follow(write))
    robot = load_robot_from_urdf(text, "coupled")
    free = load_robot_from_urdf(follow(write), "free")
    assert_allclose([robot.lower[0], robot.upper[0]], [max((1 - 0.2) / -0.5, free.lower[0]), min(2.4, free.upper[0])])
    assert robot.lower[0] == -1.6
    assert_allclose(robot.velocity_limit, [min(1.2, free.velocity_limit[0])])
    far = load_robot_from_urdf(text.replace('offset="0.2"', 'offset="90"'), "far")
    assert any("no position of shoulder brings elbow" in w for w in far.warnings)


def test_a_follower_moves_with_what_its_drive_travels(write):
    """Of a slide that travels 1.1 m per metre of its reading, the follower at -0.5 rad/m takes -0.55."""
    text = follow(write).replace("</robot>", '<tau_dyn:drive joint="shoulder" scale="1.1"/></robot>')
    text = text.replace('"shoulder" type="revolute"', '"shoulder" type="prismatic"')
    share, offset = load_robot_from_urdf(text, "coupled").coupling
    assert_allclose(share, [[1.1], [-0.55]])
    assert_allclose(offset, [0.0, 0.2])


def test_a_chain_of_mimics_multiplies_and_a_ring_is_refused(write):
    """What is followed may follow; naming the follower as actuated sets it free."""
    third = write.joint("wrist", "revolute", "lower_link", "hand_link", "0 1 0", "0.3 0 0")
    third = third.replace("<parent", '<mimic joint="elbow" multiplier="2" offset="0.1"/><parent')
    text = follow(write).replace("</robot>", write.link("hand_link", 1.0) + third + "</robot>")
    mimic = load_robot_from_urdf(text, "chain").mimics["wrist"]
    assert (mimic.joint, mimic.multiplier) == ("shoulder", -1.0)
    assert_allclose(mimic.offset, 0.1 + 2 * 0.2)
    freed = load_robot_from_urdf(text, "freed", actuated=["shoulder", "elbow"])
    assert freed.mimics["wrist"].joint == "elbow" and any("their <mimic> does not count" in w for w in freed.warnings)
    ring = text.replace('joint="shoulder" multiplier', 'joint="wrist" multiplier')
    with raises_code("robot_structure", "comes back to itself"):
        load_robot_from_urdf(ring, "ring")


def test_friction_of_the_file_is_nominal(write):
    """It is where a fit starts and what stays where no data speak."""
    text = write.pendulum().replace("<limit", '<dynamics damping="0.4" friction="1.2"/><limit')
    model = build_model(load_robot_from_urdf(text, "pendulum"), "asymmetric")
    values = {name: model.parameters[f"pivot.{name}"].value for name in ("viscous_pos", "viscous_neg", "coulomb_pos")}
    assert values == {"viscous_pos": 0.4, "viscous_neg": 0.4, "coulomb_pos": 1.2}


@pytest.mark.parametrize(("kind", "axis"), [("spherical", "0 1 0"), ("revolute", "0 0 1")])
def test_a_proposed_constraint_closes_a_loop(write, kind, axis):
    """A proposal to urdfdom (pull request 264): as a ball, or as a hinge, which is two balls on its axis."""
    text = write.four_bar()
    start, end = (
        text.index("<drake:ball_constraint>"),
        text.index("</drake:ball_constraint>") + len("</drake:ball_constraint>"),
    )
    ball = text[start:end]
    points = [part.split('value="')[1].split('"')[0] for part in ball.split("<")[1:] if "_p_" in part]
    links = [part.split('name="')[1].split('"')[0] for part in ball.split("<")[1:] if "_body_" in part]
    sides = "".join(
        f'<{side} link="{link}"/><{side}_origin xyz="{point}"/><{side}_axis xyz="{axis}"/>'
        for side, link, point in zip(("parent", "child"), links, points, strict=True)
    )
    proposed = text.replace(ball, f'<constraint name="c" type="{kind}">{sides}</constraint>')
    one, other = load_robot_from_urdf(text, "ball"), load_robot_from_urdf(proposed, "proposed")
    q, v, a = (
        one.home + 0.1 * np.random.default_rng(0).normal(size=(20, 1)),
        *np.random.default_rng(1).normal(size=(2, 20, 1)),
    )
    assert_allclose(
        build_mechanism(other).inverse_dynamics(q, v, a),
        build_mechanism(one).inverse_dynamics(q, v, a),
        rtol=1e-9,
        atol=1e-9,
    )
    with raises_code("unsupported", "type='gearbox'", "spherical"):
        load_robot_from_urdf(proposed.replace(f'type="{kind}"', 'type="gearbox"'), "gear")


def test_an_srdf_names_passive_joints(write, tmp_path):
    """The one beside the file of the same name, or one given; without it a loop's motors cannot be guessed."""
    path = tmp_path / "bars.urdf"
    path.write_text(write.four_bar(driven=""))
    passive = '<robot name="bars"><passive_joint name="coupler"/><passive_joint name="rocker"/></robot>'
    (tmp_path / "given.srdf").write_text(passive)
    assert load_robot(path, srdf=tmp_path / "given.srdf").actuated == ("crank",)
    with raises_code("robot_structure", "--actuated"):
        load_robot(path)
    (tmp_path / "bars.srdf").write_text(passive)
    assert load_robot(path).actuated == ("crank",)
    with raises_code("file_format", "<srdf>"):
        (tmp_path / "bad.srdf").write_text("<srdf/>")
        load_robot(path, srdf=tmp_path / "bad.srdf")


def test_a_link_named_like_a_joint_gets_a_name_of_its_own(write, tmp_path):
    """Parameters are named after both; what the file calls them is said."""
    path = tmp_path / "twins.urdf"
    path.write_text(write.pendulum().replace("rod_link", "pivot"))
    robot = load_robot(path)
    assert "pivot_link.mass" in robot.parameters and any(
        "'pivot' pivot_link" in sentence for sentence in robot.warnings
    )


def test_the_tool_is_found_by_usual_names_and_endings(write):
    """`tool0` before `flange`; a single frame that ends so; no guess among several."""
    hand = '<link name="{0}"/><joint name="{0}_j" type="fixed"><parent link="lower_link"/><child link="{0}"/></joint>'
    text = write.two_link()

    def tool(*names: str) -> str:
        return load_robot_from_urdf(text.replace("</robot>", "".join(map(hand.format, names)) + "</robot>"), "arm").tool

    assert tool() == "lower_link" and tool("flange", "tool0") == "tool0"
    assert tool("left", "my_hand_tcp") == "my_hand_tcp" and tool("a_tcp", "b_tcp") == ""


@pytest.mark.skipif("ur5" not in list_stock_robots(), reason="example-robot-data is not installed")
def test_a_stock_arm_answers_by_name():
    """Its own file, its own tool."""
    robot = load_robot("ur5")
    assert (robot.na, robot.tool) == (6, "tool0")
    assert_allclose(
        forward_kinematics(robot, np.zeros((1, 6))).poses.position[0], [0.81725, 0.19145, -0.005491], atol=1e-9
    )


def test_a_robot_of_robot_descriptions_is_found_where_its_cache_is(write, tmp_path, monkeypatch):
    """Its modules clone when they are imported, so none is: the text says which file, with which arguments."""
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    (package / "_repositories.py").write_text(
        'R = {\n "arms": Repository(\n url="u", commit="c", cache_path="arms_cache",\n ),\n}'
    )
    (package / "arm_description.py").write_text(
        "raise SystemExit\nP: str = _clone_to_cache('arms', commit=None)\nXACRO_PATH: str = _path.join(P, 'arm.urdf.xacro')\n"
        "XACRO_ARGS = {'kind': 'two_link'}\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    with raises_code("file_not_found", "arm_description", "cache"):
        find_robot("arm_description")
    (tmp_path / "cache" / "arms_cache").mkdir(parents=True)
    path = tmp_path / "cache" / "arms_cache" / "arm.urdf.xacro"
    (path.parent / "two_link.xacro").write_text(write.two_link())
    path.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="kind" default="none"/>'
        '<xacro:include filename="$(arg kind).xacro"/></robot>'
    )
    robot = load_robot("arm_description")
    assert robot.na == 2 and dict(robot.arguments) == {"kind": "two_link"}
    assert Path(find_robot("arm_description")) == path


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('mass value="2.0"', 'mass value="8_0"', "link 'rod_link': <mass value='8_0'>"),
        ('mass value="2.0"', 'mass value="\u0662"', "link 'rod_link': <mass"),
        ('mass value="2.0"', 'mass value="1e308"', "link 'rod_link': <mass value='1e308'>"),
        ('mass value="2.0"', 'mass value="0x10"', "link 'rod_link': <mass value='0x10'>"),
        ('lower="-3" upper="3"', 'lower="3" upper="-3"', "joint 'pivot': <limit lower='3' upper='-3'>"),
        ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', "joint 'pivot': <axis xyz='0 0 0'> has no direction"),
        ('name="rod_link"', 'name="rod&#10;link"', "'rod\\nlink'"),
        ('ixx="0" ixy="0" ixz="0" iyy="0"', 'ixx="-1" ixy="0" ixz="0" iyy="1"', "link 'rod_link': its principal moments"),
        ('izz="0"', 'izz="1"', "link 'rod_link': its principal moments"),
    ],
)  # fmt: skip
def test_numbers_and_names_that_programs_read_differently_are_refused(write, tmp_path, old, new, place):
    """As a file and as text, in one sentence with the place."""
    text = write.pendulum()
    assert old in text
    path = tmp_path / "hostile.urdf"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with raises_code("robot_structure", place):
        load_robot(path)
    with raises_code("robot_structure", place):
        load_robot_from_urdf(text.replace(old, new), "text")


def test_fitted_inertias_are_taken_where_they_are_called_so(write, tmp_path):
    """Published inertias may come from forces; the mark stays in the text that a model file carries."""
    path = tmp_path / "fitted.urdf"
    path.write_text(write.pendulum().replace('izz="0"', 'izz="1"'))
    robot = load_robot(path, fitted_inertias=True)
    assert load_robot_from_urdf(robot.urdf, "again").na == 1
