"""Joints that are held still: the robot moves as if they were welded at their positions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.robot.held_joints import hold_joints


def place(urdf: str, q: dict[str, float], frame: str) -> np.ndarray:
    """Return the place (3,) of a frame of a URDF text at joint positions, by Pinocchio."""
    model = pin.buildModelFromXML(urdf)
    data, x = model.createData(), pin.neutral(model)
    for name, value in q.items():
        x[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, x)
    return data.oMf[model.getFrameId(frame)].translation.copy()


def test_a_held_hinge_is_welded_at_its_angle(write):
    """The elbow held at 0.7 rad: the lower link is where the free elbow has it at 0.7 rad, for any shoulder."""
    held = hold_joints(write.two_link(), {"elbow": 0.7}, "arm")
    for shoulder in (-0.4, 1.1):
        assert_allclose(
            place(held, {"shoulder": shoulder}, "lower_link"),
            place(write.two_link(), {"shoulder": shoulder, "elbow": 0.7}, "lower_link"),
            atol=1e-12,
        )
    robot = load_robot_from_urdf(held, "arm")
    assert robot.actuated == ("shoulder",)


def test_a_held_slide_is_welded_at_its_place(write):
    """A slide along y of a turned frame, held at 0.2 m, moves its link by 0.2 m along that axis."""
    urdf = write.text(
        "slide",
        write.rod("a_link", 1, 0.1) + write.joint("turn", "revolute", "base_link", "a_link"),
        write.rod("b_link", 1, 0.1)
        + write.joint("slide", "prismatic", "a_link", "b_link", "0 2 0", "0.3 0 0", yaw=0.5),
        write.drive("turn"),
        write.drive("slide"),
    )
    held = hold_joints(urdf, {"slide": 0.2}, "slide")
    assert_allclose(
        place(held, {"turn": 0.3}, "b_link"), place(urdf, {"turn": 0.3, "slide": 0.2}, "b_link"), atol=1e-12
    )


def test_links_behind_a_joint_without_a_motor_are_part_of_the_body_before(write, rng):
    """The elbow without a motor: one body has the mass of both links and gives the forces of two links at rest to each other."""
    robot = load_robot_from_urdf(write.two_link(), "arm", actuated=["shoulder"])
    apart = load_robot_from_urdf(write.two_link(), "arm", actuated=["shoulder"], hold_passive=False)
    assert robot.merged_links == {"lower_link": "upper_link"} and len(apart.links) == len(robot.links) + 1
    assert robot.parameters["upper_link.mass"].value == sum(
        p.value for p in apart.parameters if p.name.endswith(".mass")
    )
    q, v, a = rng.uniform(-1, 1, (3, 20, 1))
    want = Model.of(apart).mechanism.inverse_dynamics(q, v, a)
    assert_allclose(Model.of(robot).mechanism.inverse_dynamics(q, v, a), want, rtol=1e-12)
    assert "held still at zero" in robot.warnings[-1] and robot.warnings[-1] == apart.warnings[-1]


def test_a_saved_model_with_a_held_link_of_its_own_keeps_it(write, tmp_path):
    """Models saved with bodies behind held joints are read with these bodies, and give the same forces."""
    apart = load_robot_from_urdf(write.two_link(), "arm", actuated=["shoulder"], hold_passive=False)
    Model.of(apart).save(tmp_path / "model.yaml")
    read = Model.load(tmp_path / "model.yaml")
    assert "lower_link.mass" in read.parameters
    x = np.full((1, 1), 0.4)
    want = Model.of(apart).mechanism.inverse_dynamics(x, x, x)
    assert_allclose(read.mechanism.inverse_dynamics(x, x, x), want, rtol=1e-12)


def test_a_planar_base_without_a_drive_is_held_at_zero(write):
    """A base on a planar joint that no motor moves is held still, with a warning; the mast alone is actuated."""
    base = write.rod("chassis_link", 20, 0.4) + write.joint("ground", "planar", "base_link", "chassis_link")
    mast = write.rod("mast_link", 2, 0.4) + write.joint("tilt", "revolute", "chassis_link", "mast_link", "0 1 0")
    robot = load_robot_from_urdf(write.text("mobile", base, mast, write.drive("tilt")), "mobile")
    assert robot.model.nv == 1 and any("ground" in warning for warning in robot.warnings)
    with pytest.raises(InputError, match="--hold ground=0"):
        load_robot_from_urdf(write.text("mobile", base, mast), "mobile")


def test_a_joint_that_does_not_exist_or_has_several_freedoms_is_refused(write):
    """An unknown name is an error with the known names; a planar joint is held at zero only."""
    with pytest.raises(UnknownName, match="wrist"):
        hold_joints(write.two_link(), {"wrist": 0.0}, "arm")
    base = write.rod("chassis_link", 20, 0.4) + write.joint("ground", "planar", "base_link", "chassis_link")
    with pytest.raises(InputError, match="hold it at 0"):
        hold_joints(write.text("mobile", base), {"ground": 0.3}, "mobile")
