"""Loops and couplings that only Gazebo knows are part of the mechanism, or the file is refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot, load_robot_from_urdf


@pytest.mark.parametrize(
    "inner", ["<parent_link>{}</parent_link><child_link>{}</child_link>", "<parent>{}</parent><child>{}</child>"]
)
def test_a_loop_that_gazebo_closes_is_refused(write, inner):
    """A plugin or a joint of a <gazebo> element that connects two links is no part of the tree: its name is in the message."""
    tag = "joint" if "<parent>" in inner else "plugin"
    gazebo = f'<gazebo><{tag} name="closing">{inner.format("upper_link", "lower_link")}</{tag}></gazebo>'
    urdf = write.two_link().replace("</robot>", f"{gazebo}</robot>")
    with pytest.raises(InputError, match="closing.*upper_link and lower_link"):
        load_robot_from_urdf(urdf, "arm")
    harmless = write.two_link().replace("</robot>", '<gazebo><plugin name="control"/></gazebo></robot>')
    assert load_robot_from_urdf(harmless, "arm").actuated == ("shoulder", "elbow")


@pytest.mark.parametrize(
    "ends", ["<parent>world</parent><child>lower_link</child>", '<parent link="lower_link"/><child link="world"/>']
)
def test_a_loop_to_gazebos_world_is_refused(write, ends):
    """A moving link that a Gazebo joint ties to the world closes a loop, although `world` is no link of the file."""
    urdf = write.two_link().replace("</robot>", f'<gazebo><joint name="closing">{ends}</joint></gazebo></robot>')
    with pytest.raises(InputError, match="closing.*lower_link and base_link"):
        load_robot_from_urdf(urdf, "arm")


def test_a_base_that_gazebo_fixes_to_the_world_is_no_loop(write):
    """The base link does not move, so a Gazebo joint between it and the world constrains nothing."""
    glue = '<gazebo><joint name="glue"><parent>world</parent><child>base_link</child></joint></gazebo>'
    robot = load_robot_from_urdf(write.two_link().replace("</robot>", f"{glue}</robot>"), "arm")
    assert robot.actuated == ("shoulder", "elbow")


def test_gazebos_mimic_plugin_couples_joints_as_mimic_does(write):
    """`position = multiplier * leader + offset`: the plugin and URDF's own element give the same robot."""
    law = "<multiplier>-0.5</multiplier><offset>0.2</offset>"
    plugin = f'<gazebo><plugin name="m"><joint>shoulder</joint><mimicJoint>elbow</mimicJoint>{law}</plugin></gazebo>'
    coupled = load_robot_from_urdf(write.two_link().replace("</robot>", f"{plugin}</robot>"), "arm")
    elbow, rule = '<joint name="elbow" type="revolute">', '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'
    plain = load_robot_from_urdf(write.two_link().replace(elbow, elbow + rule), "arm")
    assert coupled.actuated == plain.actuated == ("shoulder",) and coupled.mimics == plain.mimics
    tools = [forward_kinematics(robot, np.array([0.3])).poses.position for robot in (coupled, plain)]
    assert_allclose(tools[0], tools[1], atol=1e-12)


def test_a_follower_of_a_held_joint_is_held_at_its_own_position(write, tmp_path):
    """The plugin's law gives the follower's place as `<mimic>` does: held at 0.4 rad, the follower stays at 0 rad."""
    law = "<multiplier>-0.5</multiplier><offset>0.2</offset>"
    plugin = f'<gazebo><plugin name="m"><joint>elbow</joint><mimicJoint>wrist</mimicJoint>{law}</plugin></gazebo>'
    hand = write.rod("hand_link", 1, 0.2) + write.joint(
        "wrist", "revolute", "lower_link", "hand_link", "0 1 0", "0.3 0 0"
    )
    path = tmp_path / "arm.urdf"
    path.write_text(write.two_link().replace("</robot>", f"{hand}{plugin}</robot>"))
    robot = load_robot(path, hold={"elbow": 0.4}, tool="hand_link")
    assert robot.actuated == ("shoulder",) and robot.model.njoints == 2
    place = forward_kinematics(robot, np.array([0.0])).poses.position[0]
    assert_allclose(place, [0.4 + 0.3 * np.cos(0.4), 0.0, -0.3 * np.sin(0.4)], atol=1e-12)
