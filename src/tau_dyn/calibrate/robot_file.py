"""Writes calibrated dimensions to the robot file, for every program that reads it; comments are lost, all else is unchanged.

In a tree an offset becomes part of its joint's placement, `R exp([r]x) exp(offset axis)` for a rotary joint, a shift along the
axis for a slide. The sign and scale of the encoders do not change. In a robot with rods a guideway gets its axis, a rotary joint
its orientation, and a rod its length at its ball, its ends at the carrying joint and at the point of attachment. A slide's travel
per reading is `<tau_dyn:drive joint="" scale=""/>` (`Robot.drive_scale`). Parameters that a file cannot hold are refused.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, register_namespace, tostring

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import ChainJoint, RodDimensions, Rods, TreeNumbers, TreeShape
from tau_dyn.robot import Robot

_DRAKE = ("http://drake.mit.edu", "https://drake.mit.edu")
_OURS = "urn:tau_dyn"


def format_corrected_tree(shape: TreeShape, numbers: TreeNumbers) -> str:
    """Return a tree's robot file with calibrated joint placements, offsets, rod lengths, loop points and drives' scales.

    Raises:
        InputError: The gain of a turning joint, or the place of a tool that has no fixed joint of its own.
    """
    file = _RobotFile(shape.robot)
    changed = numbers.gain != shape.robot.drive_scale
    for joint, unit, gain in zip(
        np.array(shape.robot.actuated)[changed],
        np.array(shape.robot.position_units)[changed],
        numbers.gain[changed],
        strict=True,
    ):
        if unit != "m":
            raise InputError(
                "unsupported",
                f"{shape.robot.source}: {joint}.gain is {gain:.6g}, and a robot file has no gear ratios; fix the gains in the "
                "fit, or correct the encoder's scale",
            )
        file.write_scale(joint, float(gain))
    for k, name in enumerate(shape.names):
        placement = _compute_placement(shape, numbers, k)
        joint = shape.joints[k]
        if not placement.isApprox(shape.within[k].actInv(pin.SE3(joint.rotation, joint.offset)), 1e-15):
            file.write_placement(name, placement)
    for end, (_, point), local in zip(shape.ends, file.points, numbers.points, strict=True):
        if not np.array_equal(local, end.local):
            _set(point, "value", file.find_link(end.link).actInv(local))
    shift = numbers.tool - shape.tool.local
    if shift.any():
        file.shift_tool(shape.tool.link, shift)
    return file.format()


def _compute_placement(shape: TreeShape, numbers: TreeNumbers, k: int) -> pin.SE3:
    """Return a joint's calibrated placement in its parent link, its offset included."""
    joint = numbers.joints[k]
    placement = pin.SE3(joint.rotation, joint.offset)
    if joint.v in shape.active:
        offset = float(numbers.offset[np.flatnonzero(shape.active == joint.v)[0]]) * joint.axis
        placement *= pin.SE3(np.eye(3), offset) if joint.slides else pin.SE3(pin.exp3(offset), np.zeros(3))
    return shape.within[k].actInv(placement)


def format_corrected_rods(rods: Rods, new: RodDimensions) -> str:
    """Return the file of a robot of rods with other dimensions.

    Raises:
        InputError: A rod that the file does not hold by a ball of its own.
    """
    file, old, model = _RobotFile(rods.robot), rods.numbers, rods.robot.model
    for before, after in zip(old.joints, new.joints, strict=True):
        _write_joint(file, before, after)
    balls = {end[0]: (end, other) for a, b in file.balls for end, other in ((a, b), (b, a))}
    plate = int(model.frames[model.getFrameId(rods.plate)].parentJoint)
    ends = {0, plate, *(model.getJointId(joint.name) for joint in old.joints)}
    base, on_plate = new.carried.local - old.carried.local, new.on_plate - old.on_plate
    for k, name in enumerate(old.names):
        if new.lengths[k] == old.lengths[k] and not base[k].any() and not on_plate[k].any():
            continue
        if f"{name}_link" not in balls:
            raise InputError(
                "unsupported",
                f"{rods.robot.source}: its file has no ball of its own for rod '{name}', where a rod's length stands",
            )
        (link, tip), (tied_link, tied) = balls[f"{name}_link"]
        joint, place = int(model.frames[model.getFrameId(link)].parentJoint), file.find_link(link)
        _set(
            tip, "value", _get(tip, "value") + place.rotation.T @ _lengthen(rods, new, k, place.act(_get(tip, "value")))
        )
        while int(model.parents[joint]) not in ends:
            joint = int(model.parents[joint])
        hung, ball = (on_plate[k], base[k]) if int(model.parents[joint]) == plate else (base[k], on_plate[k])
        file.shift_joint(model.names[joint], hung)
        _set(tied, "value", _get(tied, "value") + file.find_link(tied_link).rotation.T @ ball)
    return file.format()


def _write_joint(file: _RobotFile, before: ChainJoint, after: ChainJoint) -> None:
    """Write an actuated joint's place, its frame if it turns, its axis and its drive's scale if it slides."""
    file.shift_joint(before.name, after.origin - before.origin)
    if not before.slides and not np.array_equal(before.rotation, after.rotation):
        file.turn_joint(before.name, after.rotation)
    elif before.slides and not np.array_equal(before.direction, after.direction):
        scale = float(np.linalg.norm(after.direction))
        file.write_axis(before.name, after.rotation.T @ after.direction / scale)
        file.write_scale(before.name, scale)


def _lengthen(rods: Rods, new: RodDimensions, k: int, tip: np.ndarray) -> np.ndarray:
    """Return the shift of a rod's ball (3,) [m] from `tip` in the frame of its joint, along the rod or the slide."""
    old, model = rods.numbers, rods.robot.model
    if old.slides[k] < 0:
        return tip * (new.lengths[k] / old.lengths[k] - 1)
    reach = [np.sqrt(x.lengths[k] ** 2 - x.offsets[k] ** 2) for x in (old, new)]
    slide = model.joints[model.getJointId(rods.robot.actuated[old.slides[k]])].createData()
    return np.sign(old.gains[k]) * np.asarray(slide.S).reshape(6, -1)[:3, 0] * (reach[1] - reach[0])


class _RobotFile:
    """A robot's file, open for changes; places and vectors are in the frame of the joint that carries them.

    Attributes:
        balls: Links and points of all `<drake:ball_constraint>`, sides A and B, in the file's order.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, self._root = robot, fromstring(robot.urdf)
        self._joints = {e.get("name", ""): e for e in self._root.findall("joint")}
        self.balls = [
            ((_child(e, f"{{{uri}}}ball_constraint_body_A").get("name", ""), _child(e, f"{{{uri}}}ball_constraint_p_AP")),
             (_child(e, f"{{{uri}}}ball_constraint_body_B").get("name", ""), _child(e, f"{{{uri}}}ball_constraint_p_BQ")))
            for uri in _DRAKE for e in self._root.findall(f"{{{uri}}}ball_constraint")
        ]  # fmt: skip
        self.points = [end for pair in self.balls for end in pair]

    def find_link(self, link: str) -> pin.SE3:
        """Return the placement of a link in the frame of its joint."""
        model = self.robot.model
        return model.frames[model.getFrameId(link, pin.FrameType.BODY)].placement

    def write_placement(self, joint: str, placement: pin.SE3) -> None:
        """Write a joint's placement in its parent link."""
        origin = _child(self._joints[joint], "origin")
        _set(origin, "xyz", placement.translation)
        _set(origin, "rpy", pin.rpy.matrixToRpy(placement.rotation))

    def shift_joint(self, joint: str, shift: np.ndarray) -> None:
        """Shift a joint (3,) [m]."""
        if shift.any():
            origin = _child(self._joints[joint], "origin")
            _set(origin, "xyz", _get(origin, "xyz") + self._find_parent(joint).rotation.T @ shift)

    def turn_joint(self, joint: str, rotation: np.ndarray) -> None:
        """Write the orientation (3, 3) of a joint's frame."""
        turned = self._find_parent(joint).rotation.T @ rotation
        _set(_child(self._joints[joint], "origin"), "rpy", pin.rpy.matrixToRpy(turned))

    def write_axis(self, joint: str, axis: np.ndarray) -> None:
        """Write a joint's axis (3,), in its own frame."""
        _set(_child(self._joints[joint], "axis"), "xyz", axis)

    def write_scale(self, joint: str, scale: float) -> None:
        """Write a slide's travel per reading of its drive."""
        known = [e for e in self._root.findall(f"{{{_OURS}}}drive") if e.get("joint") == joint]
        element = known[0] if known else SubElement(self._root, f"{{{_OURS}}}drive", joint=joint)
        element.set("scale", f"{scale:.17g}")

    def shift_tool(self, tool: str, shift: np.ndarray) -> None:
        """Shift the tool frame (3,) [m].

        Raises:
            InputError: It has no fixed joint of its own.
        """
        for name, joint in self._joints.items():
            if joint.get("type") == "fixed" and tool in (name, _child(joint, "child").get("link")):
                return self.shift_joint(name, shift)
        raise InputError(
            "unsupported",
            f"{self.robot.source}: the tool frame '{tool}' has no fixed joint of its own, whose place could be corrected",
        )

    def _find_parent(self, joint: str) -> pin.SE3:
        return self.find_link(_child(self._joints[joint], "parent").get("link", ""))

    def format(self) -> str:
        """Return the file's text."""
        for prefix, uri in (("drake", _DRAKE[0]), ("tau_dyn", _OURS)):
            register_namespace(prefix, uri)
        return tostring(self._root, encoding="unicode") + "\n"


def _child(element: Element, tag: str) -> Element:
    """Return an element's part, added where it is missing."""
    found = element.find(tag)
    return SubElement(element, tag) if found is None else found


def _get(element: Element, attribute: str) -> np.ndarray:
    return np.array([float(x) for x in (element.get(attribute) or "0 0 0").split()])


def _set(element: Element, attribute: str, vector: np.ndarray) -> None:
    element.set(attribute, " ".join(f"{x + 0.0:.17g}" for x in vector))
