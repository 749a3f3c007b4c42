"""A model's robot as SDF 1.11 for Gazebo: one link per movable joint, loops as ball joints, Drake's element for drive inertia.

Every movable joint becomes a link with the model's inertia (links fixed to it merged in) at the joint's position. SDF does not
close loops: ball joints connect the links at the poses in the file. Therefore a robot with loops is written at its home
position, from which its joints count. Viscous and Coulomb friction are attributes of the joints. SDF has no element for drive
inertia; it is written as `drake:rotor_inertia`, which Gazebo ignores.
Reference: sdformat.org, specification 1.11.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.exchange.content import (
    Exported,
    build_body,
    build_carried_model,
    format_header,
    list_nominal_parameters,
    list_omissions,
    raise_moments,
    read_joint_law,
    split,
)
from tau_dyn.mechanism import Joint, LoopSolver, list_joints
from tau_dyn.model import Model

_DRAKE = "drake.mit.edu"
_LIGHT, _THIN = 1e-9, 1e-12  # kg and kg m^2, of bodies without mass, as in the MJCF
_ENTRIES = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))


def build_sdf(model: Model) -> Exported:
    """Return the model's robot as SDF text.

    Raises:
        InputError: A joint has more than one degree of freedom, a drive has a scale, or the base floats.
    """
    robot = model.robot
    robot.require_unscaled_drives("an SDF file")
    robot.require_fixed_base("an SDF file")
    joints = list_joints(robot.model)
    if joints is None:
        raise InputError(
            "unsupported", f"{robot.source}: SDF is written for robots of joints with one degree of freedom each"
        )
    carried = build_carried_model(model, drives=False)
    held = robot.held_positions
    home = _find_home(model, joints) if robot.loops else [held.get(robot.model.names[j.index], 0.0) for j in joints]
    left_out = [*list_omissions(model, drives=False), *_list_losses(model, carried)]
    ElementTree.register_namespace("drake", _DRAKE)
    root = Element("sdf", version="1.11")
    root.append(Comment(f" {format_header(model, left_out)} "))
    top = SubElement(root, "model", name=robot.name)
    names = _name_links(model)
    for joint, q in zip(joints, home, strict=True):
        _add_link(top, carried, joint, q, names)
    for joint, q in zip(joints, home, strict=True):
        _add_joint(top, carried, joint, q, names)
    for loop in robot.loops:
        a, b = (robot.model.frames[k] for k in (loop.frame_a, loop.frame_b))
        ball = SubElement(top, "joint", name=f"{a.name}_{b.name}", type="ball")
        _add_pose(ball, b.placement.translation)
        SubElement(ball, "parent").text = names[a.parentJoint]
        SubElement(ball, "child").text = names[b.parentJoint]
    ElementTree.indent(root)
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    lost = {f"{j}.armature": 0.0 for j in robot.actuated}
    lost |= {n: 0.0 for n in carried.parameters.names if n.endswith((".armature_error", ".gravity_mass"))}
    return Exported(text, tuple(left_out), carried.with_values(lost), list_nominal_parameters(model), split(model))


def _find_home(model: Model, joints: list[Joint]) -> list[float]:
    """Return the closed configuration at home, one position per joint [m or rad]."""
    robot, found = model.robot, []
    q = LoopSolver(robot).close(robot.home)
    for joint in joints:
        item = robot.model.joints[joint.index]
        k = item.idx_q
        found.append(float(np.arctan2(q[k + 1], q[k]) if item.nq == 2 else q[k]))
    return found


def _list_losses(model: Model, carried: Model) -> list[str]:
    """Return one sentence for each part of the model, other than effects, that SDF cannot carry."""
    robot, said = model.robot, ["visual and collision shapes are left out"]
    driven = [j for j in robot.actuated if read_joint_law(carried, j).armature]
    if driven:
        said.append(f"drive inertia of {', '.join(driven)} is left out for Gazebo: it is in drake:rotor_inertia")
    if any(n.endswith(".gravity_mass") and robot.parameters[n].value for n in robot.parameters.names):
        said.append("mass that only gravity feels is left out")
    if robot.loops:
        said.append(
            "joints count from home, where the ball joints of its loops are closed; engines without loops refuse it"
        )
    light = len(list_joints(robot.model) or []) - len(robot.links)
    if light:
        said.append(f"{light} {'body' if light == 1 else 'bodies'} without mass get {_LIGHT:g} kg")
    return said


def _name_links(model: Model) -> dict[int, str]:
    """Return the name of each joint's link by the joint's index; in SDF a link and a joint may not share a name."""
    frames = model.robot.model.frames.tolist()
    names = {f.parentJoint: f.name for f in reversed(frames) if f.type == pin.FrameType.BODY}
    taken = set(model.robot.model.names)
    return {k: f"{name}_body" if name in taken else name for k, name in names.items()} | {0: "world"}


def _add_link(top: Element, model: Model, joint: Joint, q: float, names: dict[int, str]) -> None:
    """Add a joint's link at its pose for the joint position `q`."""
    rotation, place = joint.place(q)
    link = SubElement(top, "link", name=names[joint.index])
    parent = {"relative_to": names[joint.parent]} if joint.parent else {}
    _add_pose(link, place, rotation, **parent)
    inertial = SubElement(link, "inertial")
    carrier = next((x for x in model.robot.links if x.joint_id == joint.index), None)
    if carrier is None:
        mass, centre, axes, inertia = _LIGHT, np.zeros(3), np.eye(3), _THIN * np.eye(3)
    else:
        mass, centre, inertia = build_body(carrier, model)
        raised = raise_moments(inertia)
        axes = np.eye(3) if raised is None else raised[1]
        inertia = inertia if raised is None else np.diag(raised[0])
    _add_pose(inertial, centre, axes)
    SubElement(inertial, "mass").text = repr(float(mass))
    entries = SubElement(inertial, "inertia")
    for name, i, j in _ENTRIES:
        SubElement(entries, name).text = repr(float(inertia[i, j]))


def _add_joint(top: Element, model: Model, joint: Joint, q: float, names: dict[int, str]) -> None:
    """Add a joint with its limits and friction, its position counted from `q`."""
    robot, name = model.robot, model.robot.model.names[joint.index]
    item = robot.model.joints[joint.index]
    low, high = robot.model.lowerPositionLimit[item.idx_q], robot.model.upperPositionLimit[item.idx_q]
    limited = item.nq == 1 and low < high and np.isfinite(low + high) and high - low < 1e10
    kind = "prismatic" if joint.slides else "revolute" if limited else "continuous"
    element = SubElement(top, "joint", name=name, type="fixed" if name in robot.held_positions else kind)
    SubElement(element, "parent").text = names[joint.parent]
    SubElement(element, "child").text = names[joint.index]
    if name in robot.held_positions:
        return
    axis = SubElement(element, "axis")
    SubElement(axis, "xyz").text = _numbers(joint.axis)
    limit = SubElement(axis, "limit")
    if limited:
        SubElement(limit, "lower").text, SubElement(limit, "upper").text = repr(float(low - q)), repr(float(high - q))
    driven = name in robot.actuated
    effort = robot.effort_limit[robot.actuated.index(name)] if driven else 0.0
    if np.isfinite(effort):
        SubElement(limit, "effort").text = repr(float(effort))
    if name in robot.mimics:
        mimic = robot.mimics[name]
        follower = SubElement(axis, "mimic", joint=mimic.joint)
        for key, value in (("multiplier", mimic.multiplier), ("offset", mimic.offset), ("reference", 0.0)):
            SubElement(follower, key).text = repr(float(value))
    if driven:
        law = read_joint_law(model, name)
        dynamics = SubElement(axis, "dynamics")
        SubElement(dynamics, "damping").text, SubElement(dynamics, "friction").text = (
            repr(law.viscous),
            repr(law.coulomb),
        )
        if law.armature:
            SubElement(element, f"{{{_DRAKE}}}rotor_inertia").text = repr(law.armature)
            SubElement(element, f"{{{_DRAKE}}}gear_ratio").text = "1.0"


def _add_pose(element: Element, place: Any, turn: np.ndarray | None = None, **more: str) -> None:
    rpy = np.zeros(3) if turn is None else pin.rpy.matrixToRpy(np.asarray(turn, float))
    SubElement(element, "pose", more).text = _numbers([*np.asarray(place, float), *rpy])


def _numbers(values: Any) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(values, float).ravel())
