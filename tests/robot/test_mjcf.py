"""MJCF read by ourselves: the same forces as MuJoCo's inverse dynamics, or a sentence that names the element."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism import build_mechanism, forward_kinematics
from tau_dyn.robot import Robot, load_robot

ARM = """<mujoco model="arm">
  <compiler eulerseq="ZYx" inertiafromgeom="auto" boundmass="0.05" boundinertia="1e-4"/>
  <default>
    <geom density="700"/> <joint armature="0.01"/> <motor gear="30"/>
    <default class="heavy"><geom density="2500" type="capsule" size=".03"/><joint damping="2" frictionloss="0.3"/>
      <default class="endless"><joint limited="false"/></default></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="a" pos=".1 .2 .3" euler="20 -30 40" childclass="heavy">
      <joint name="a" axis="1 2 3" pos=".01 .02 -.03" range="-100 120" ref="25" armature="0.2"/>
      <geom fromto="0 0 0 .2 .1 .3"/> <geom type="box" size=".05 .02 .04" pos="0 .1 0" axisangle="1 1 0 33" mass="0.7"/>
      <frame pos="0 0 .3" xyaxes="1 1 0 0 0 1">
        <body name="b" quat=".5 .5 .5 -.5">
          <joint name="b1" axis="0 1 0"/> <joint name="b2" type="slide" axis="1 0 1" range="-.2 .3" ref=".1"/>
          <joint name="b3" class="endless" pos="0 .05 0" axis="0 0 2"/>
          <geom type="cylinder" size=".04 .1" zaxis="1 0 2"/> <geom type="ellipsoid" size=".05 .06 .07" pos=".1 0 0"/>
          <geom type="sphere" size=".05" mass="0"/>
          <body name="c" pos="0 .2 0">
            <joint name="c" type="hinge" axis="0 0 1" damping="0.1"/>
            <inertial pos=".01 .02 .03" mass="1.5" fullinertia=".03 .02 .025 .001 -.002 .003"/>
            <geom type="box" size="9 9 9"/>
            <body name="fixed"><inertial pos="0 0 .1" mass=".2" diaginertia="1e-3 2e-3 1.5e-3" euler="10 20 30"/>
              <site name="tcp" pos="0 0 .2" euler="0 0 90"/></body>
          </body>
          <body name="d" pos="0 -.2 0"><joint name="d" axis="1 0 0" limited="true" range="-90 90"/>
            <geom type="sphere" size=".01" density="10"/></body>
        </body>
      </frame>
    </body>
  </worldbody>
  <equality><joint joint1="d" joint2="c" polycoef="0.2 -1.5"/></equality>
  <actuator>
    <motor name="a" joint="a" ctrlrange="-2 2"/> <position name="b1" joint="b1" kp="10" forcerange="-7 5" gear="2"/>
    <velocity joint="b2"/> <general joint="b3"/> <motor joint="c" gear="-1"/>
  </actuator>
</mujoco>"""


def write(folder: Path, text: str) -> Path:
    """Return a file of this text."""
    path = folder / "robot.xml"
    path.write_text(text)
    return path


def compute_reference(text: str, robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return `mj_inverse` (N, nv) at positions, speeds and accelerations of all joints (N, nv)."""
    spec = mujoco.MjSpec.from_string(text)
    for item in [*spec.equalities, *spec.keys]:
        spec.delete(item)
    model = spec.compile()
    for name in ("CONTACT", "SPRING", "DAMPER", "LIMIT", "FRICTIONLOSS"):
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
    data, out = mujoco.MjData(model), np.empty_like(q)
    order = [model.joint(name).dofadr[0] for name in robot.model.names[1:]]
    for k in range(len(q)):
        data.qpos[order], data.qvel[order], data.qacc[order] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse[order]
    return out


def check_forces(text: str, path: Path, reach: float = 1.0, **options: object) -> Robot:
    """Compare forces at random states, passive joints and followers moved as the mechanism moves them."""
    robot = load_robot(path, **options)
    mechanism, rng = build_mechanism(robot), np.random.default_rng(3)
    q = robot.home + reach * rng.uniform(-1, 1, (20, robot.na))
    v, a = rng.normal(size=(2, 20, robot.na))
    states = [mechanism.solver.state(*state) for state in zip(q, v, a, strict=True)]
    x = np.array([[s.q[j.idx_q] if j.nq == 1 else np.arctan2(s.q[j.idx_q + 1], s.q[j.idx_q])
                   for j in robot.model.joints[1:]] for s in states])  # fmt: skip
    full = compute_reference(text, robot, x, np.array([s.v for s in states]), np.array([s.a for s in states]))
    wanted = np.array([s.G.T @ tau for s, tau in zip(states, full, strict=True)])
    assert_allclose(mechanism.inverse_dynamics(q, v, a), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    assert_allclose(
        mechanism.regressor(q, v, a) @ robot.parameters.values, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max()
    )
    return robot


def test_forces_are_those_of_mujoco(tmp_path):
    """Shapes, defaults, frames, every way to write a turn, references, several joints a body, a coupling, bounded masses."""
    robot = check_forces(ARM, write(tmp_path, ARM))
    assert robot.actuated == ("a", "b1", "b2", "b3", "c") and robot.tool == "tcp"
    assert (robot.mimics["d"].joint, robot.mimics["d"].multiplier) == ("c", -1.5)
    assert_allclose(robot.mimics["d"].offset, 0.2)
    assert_allclose(robot.lower[:3], [np.deg2rad(-100), -np.inf, -0.2])
    assert_allclose(robot.effort_limit[:2], [60.0, 14.0])
    assert_allclose(robot.parameters["a.armature"].value, 0.2)
    assert_allclose(robot.parameters["c.armature"].value, 0.01 + 1.5**2 * 0.01)
    assert (robot.friction["a"].viscous, robot.friction["a"].coulomb) == (2.0, 0.3)


def test_a_motors_armature_counts_by_its_gear_squared(tmp_path):
    """A rotor of 0.01 kg m^2 behind a gear of 3 adds 0.09 to the joint's own 0.2; MuJoCo's mass matrix says the same."""
    text = """<mujoco><worldbody><body name="a"><joint name="j" axis="0 1 0" armature="0.2"/>
    <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.01"/></body></worldbody>
    <actuator><motor name="m" joint="j" gear="3" armature="0.01"/></actuator></mujoco>"""
    robot, model = load_robot(write(tmp_path, text)), mujoco.MjModel.from_xml_string(text)
    data, felt = mujoco.MjData(model), np.zeros(1)
    mujoco.mj_forward(model, data)
    mujoco.mj_mulM(model, data, felt, np.ones(1))
    assert_allclose(robot.parameters["j.armature"].value, 0.29)
    assert_allclose(build_mechanism(robot).mass_and_bias(np.zeros(1), np.zeros(1))[0].ravel(), felt)


def test_the_tool_is_where_mujoco_has_the_site(tmp_path):
    """Positions count from MuJoCo's references in both."""
    robot, model = load_robot(write(tmp_path, ARM)), mujoco.MjModel.from_xml_string(ARM)
    data, q = mujoco.MjData(model), np.array([0.3, -0.4, 0.15, 0.6, 0.2])
    for name, x in zip(robot.actuated, q, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = x
    mujoco.mj_kinematics(model, data)
    found = forward_kinematics(robot, q[None]).poses
    assert_allclose(found.position[0], data.site("tcp").xpos, atol=1e-12)
    assert_allclose(found.rotation[0].ravel(), data.site("tcp").xmat, atol=1e-12)


def link_text(name: str, pos: str, more: str = "") -> str:
    """Return a bar of 0.3 m along x that turns about y."""
    joint = f'<joint name="{name}" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>'
    return f'<body name="{name}_bar" pos="{pos}">{joint}{more}</body>'


BARS = (
    '<mujoco><worldbody>{tree}</worldbody><equality>{tie}</equality><actuator><motor joint="crank"/></actuator>'
    '<keyframe><key qpos="{home}"/></keyframe></mujoco>'
)
CHAIN = link_text("crank", "0 0 0", link_text("coupler", ".3 0 0")) + link_text("rocker", "0 0 -.3")
HOME = "-0.3 0.3 -0.3"


@pytest.mark.parametrize(
    "tie",
    [
        '<connect body1="coupler_bar" body2="rocker_bar" anchor=".3 0 0"/>',
        '<connect name="t" body1="rocker_bar" body2="coupler_bar" anchor=".3 0 0" active="true"/>',
    ],
)
def test_connect_closes_a_loop(tmp_path, tie):
    """A parallelogram as wide as the model's own pose at its references makes it."""
    tree = CHAIN.replace('pos=".3 0 0"><joint name="coupler"', 'pos=".3 0 0" euler="0 90 0"><joint name="coupler"')
    text = BARS.format(tree=tree, tie=tie, home=HOME)
    robot = check_forces(text, write(tmp_path, text), reach=0.2)
    assert len(robot.loops) == 1 and robot.actuated == ("crank",)


def test_weld_closes_a_loop(tmp_path):
    """A four-bar cut in the middle of its coupler: both halves stay one body."""
    half = (
        '<body name="half" pos=".3 0 0"><joint name="half" axis="0 1 0"/>'
        '<geom type="capsule" size=".02" fromto="0 0 0 0 0 .15"/></body>'
    )
    tree = (
        link_text("crank", "0 0 0", '<body name="coupler" pos=".3 0 0"><joint name="coupler" axis="0 1 0"/>'
                  '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.15"/></body>')
        + link_text("rocker", "0 0 -.3", half)
    )  # fmt: skip
    text = BARS.format(tree=tree, tie='<weld body1="coupler" body2="half"/>', home="0 0 0 0")
    robot = check_forces(text, write(tmp_path, text), reach=0.2)
    assert len(robot.loops) == 3


def test_a_tendon_drives_the_joint_that_the_others_follow(tmp_path):
    """A gripper's motor pulls both fingers, and an equation holds them together."""
    finger = (
        '<body name="{0}_finger" pos="0 {1} 0"><joint name="{0}" type="slide" axis="0 1 0"/><geom size=".02"/></body>'
    )
    text = (
        "<mujoco><worldbody>" + finger.format("left", ".1") + finger.format("right", "-.1") + "</worldbody>"
        '<equality><joint joint1="left" joint2="right" polycoef="0 -1"/></equality><tendon><fixed name="both">'
        '<joint joint="left" coef="0.5"/><joint joint="right" coef="-0.5"/></fixed></tendon>'
        '<actuator><position tendon="both"/></actuator></mujoco>'
    )
    assert check_forces(text, write(tmp_path, text)).actuated == ("right",)
    loose = text.replace('<joint joint1="left" joint2="right" polycoef="0 -1"/>', "")
    robot = load_robot(write(tmp_path, loose))
    assert any("tendon 'both' drives left, right together" in sentence for sentence in robot.warnings)


def test_a_free_base_stands_still_and_included_files_count(tmp_path):
    """A quadruped's scene: the robot in a file of its own, home from its keyframe behind the base's seven numbers."""
    (tmp_path / "inner.xml").write_text(
        '<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>'
        + link_text("hip", "0 0 0")
        + '</body></worldbody><keyframe><key name="home" qpos="9 9 9 1 0 0 0 0.4"/></keyframe></mujoco>'
    )
    scene = '<mujoco><include file="inner.xml"/><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    robot = load_robot(write(tmp_path, scene))
    assert_allclose(robot.home, 0.4)
    assert any("body 'base' is free in the file" in sentence for sentence in robot.warnings)


def test_a_joint_held_by_an_equation_is_no_joint(tmp_path):
    """`equality/joint` without a second joint fixes the first where it says."""
    held = '<equality><joint joint1="coupler" polycoef="0.5"/></equality>'
    text = f"<mujoco><worldbody>{CHAIN}</worldbody>{held}</mujoco>"
    robot = load_robot(write(tmp_path, text), tool="coupler_bar")
    assert robot.actuated == ("crank", "rocker")


def test_a_joint_held_turns_the_body_behind_it(tmp_path):
    """Held at 0.7 rad, a body's centre and inertia are `R c` and `R I R'` behind the joint that moves."""
    R = Rotation.from_rotvec([0.7, 0, 0]).as_matrix()
    centre, inertia = (
        np.array([0.1, 0.2, 0.3]),
        np.diag([0.03, 0.02, 0.025]) + 0.004 * (np.eye(3)[::-1] - np.diag([0, 1, 0])),
    )
    text = """<mujoco><worldbody><body name="m"><joint name="h"/><joint name="held" axis="1 0 0"/>
    <inertial pos=".1 .2 .3" mass="1" fullinertia=".03 .02 .025 0 .004 0"/></body></worldbody>
    <equality><joint joint1="held" polycoef="0.7"/></equality></mujoco>"""
    robot = load_robot(write(tmp_path, text), tool="m")
    about = R @ inertia @ R.T + np.dot(centre, centre) * np.eye(3) - np.outer(R @ centre, R @ centre)
    found = [
        robot.parameters[f"m.{name}"].value for name in ("mx", "my", "mz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ]
    assert_allclose(found, [*(R @ centre), *about[np.triu_indices(3)]], atol=1e-12)


@pytest.mark.parametrize("gravity", ["0 0 -9.8", "0 0 -9.80665", "0 0 -9.832"])
def test_gravity_of_a_place_on_earth_is_read(tmp_path, gravity):
    """Files round gravity or give that of their place: 9.78 to 9.83 m/s^2 is read as 9.81."""
    path = tmp_path / "robot.xml"
    path.write_text(f'<mujoco><option gravity="{gravity}"/><worldbody>{CHAIN}</worldbody></mujoco>')
    assert load_robot(path).model.gravity.linear[2] == -9.81


@pytest.mark.parametrize(
    ("old", "new", "code", "words"),
    [
        ('axis="1 2 3"', 'axis="0 0 0"', "robot_structure", ("<joint name='a'>", "axis='0 0 0'")),
        ('axis="1 2 3"', 'axis="1 2"', "robot_structure", ("<joint name='a'>", "3 finite number(s)")),
        ('axis="1 2 3"', 'axis="1 2 8_0"', "robot_structure", ("8_0",)),
        ('type="slide"', 'type="screw"', "robot_structure", ("'b2'", "screw")),
        ('class="endless" pos', 'class="nobody" pos', "robot_structure", ("default class 'nobody'",)),
        ('joint1="d"', 'joint1="z"', "robot_structure", ("'z'", "there are a, b1")),
        ('polycoef="0.2 -1.5"', 'polycoef="0 1 2"', "unsupported", ("polycoef='0 1 2' is not linear",)),
        ('<geom type="sphere" size=".01" density="10"/>', '<geom type="mesh" mesh="m"/>', "unsupported",
         ("<body name='d'>", "mesh 'm'", "<inertial>")),
        ('<velocity joint="b2"/>', '<general site="tcp"/>', "unsupported", ("drives a joint",)),
        ("<worldbody>", '<worldbody><replicate count="3"><geom size="1"/></replicate>', "unsupported", ("<replicate",)),
        ("<compiler", '<option gravity="0 0 -1.6"/><compiler', "unsupported", ("gravity='0 0 -1.6'",)),
        ("<compiler", '<include file="absent.xml"/><compiler', "cannot_read", ("absent.xml",)),
        ("<compiler", '<include file="robot.xml"/><compiler', "file_format", ("robot.xml twice",)),
        ('<mujoco model', '<!DOCTYPE m [<!ENTITY e "x">]><mujoco model', "file_format", ("document type",)),
        ('fullinertia=".03 .02 .025 .001 -.002 .003"', 'diaginertia="1 1 20"', "robot_structure",
         ("link 'c_link'", "at most the sum")),
        ('<body name="d"', '<body name="c"', "robot_structure", ("two bodies are called 'c'",)),
        ('name="b3"', 'name="b1"', "robot_structure", ("two joints are called 'b1'",)),
    ],
)  # fmt: skip
def test_what_is_not_read_is_named(tmp_path, old, new, code, words):
    """One sentence, whatever the element."""
    assert old in ARM
    with raises_code(code, *words):
        load_robot(write(tmp_path, ARM.replace(old, new, 1)))
