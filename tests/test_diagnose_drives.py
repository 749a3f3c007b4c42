"""Causes at drives beyond the robot's freedoms."""

import numpy as np
import redundant

from tau_dyn.by_measurement import diagnose
from tau_dyn.robot import load_robot_from_urdf


def test_hidden_friction_of_a_redundant_drive_is_named_at_that_drive() -> None:
    """A Stribeck peak of 2 N m at the drive that follows the two others; a search at those alone names one of them."""
    robot = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf")
    (joint,) = robot.redundant_joints
    motion = redundant.move_three_arms(np.arange(0, 40, 0.01))
    friction = redundant.COULOMB * np.sign(motion.v) + redundant.VISCOUS * motion.v
    v = motion.v[:, redundant.ARMS.index(joint)]
    friction[:, redundant.ARMS.index(joint)] += 2.0 * np.sign(v) * np.exp(-np.abs(v) / 0.1)
    found = diagnose(robot, redundant.write_log(motion, redundant.ARMS, friction, {joint: 4.0}, 0.05, "arms.csv"))
    assert found.verdict == "named"
    (cause,) = [f for f in found.findings if f.status == "confirmed"]
    assert cause.cause == "stribeck" and tuple(cause.joints) == (joint,)
    (peak,) = [p for p in cause.parameters if p.name == f"{joint}.stribeck"]
    assert peak.stderr is not None and abs(peak.value - 2.0) < 3 * peak.stderr
    assert any("causes were looked for at" in w for w in found.warnings)
