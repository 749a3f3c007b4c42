"""Fixed joints: a URDF text in which joints are fixed at given positions, with all elements that name them.

A held joint becomes `type="fixed"`, and its origin is composed with the motion of the joint at its position, so every later step
(tree, export, saved model) reads one file. Joints that mimic a held joint are held at their own positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree.ElementTree import Element, register_namespace, tostring

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot.gazebo import write_gazebo_mimics
from tau_dyn.robot.numbers import MAX_NUMBER, build_rotation, compute_rpy, parse_numbers

_NAMESPACES = {"drake": "http://drake.mit.edu", "tau_dyn": "urn:tau_dyn"}
_TURNS = ("revolute", "continuous")
_DROPPED = ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration")
"""Elements that do not apply to a fixed joint."""


def hold_joints(urdf: str, held: Mapping[str, float], where: str) -> str:
    """Return URDF text with joints fixed at positions.

    Args:
        urdf: URDF text that `read_annotations` accepts.
        held: Position by joint [m or rad]; joints of several degrees of freedom are held at zero only.
        where: The robot's source, for messages.

    Raises:
        UnknownName: A joint does not exist or is fixed already.
        InputError: A position is not finite, or not zero for a joint of several degrees of freedom.
    """
    for prefix, uri in _NAMESPACES.items():
        register_namespace(prefix, uri)
    root = fromstring(urdf, forbid_dtd=True)
    write_gazebo_mimics(root)
    joints = {e.get("name", ""): e for e in root.findall("joint") if e.get("type") != "fixed"}
    positions = dict(held)
    for name, value in held.items():
        if name not in joints:
            raise UnknownName("movable joint", name, list(joints), where)
        if not abs(value) < MAX_NUMBER:
            raise InputError(
                "bad_option", f"{where}: joint '{name}' cannot be held at {value:g}; give a finite position"
            )
    _add_followers(joints, positions)
    for name, value in positions.items():
        _fix(joints[name], value, where)
    for tag in ("transmission", "ros2_control"):
        for element in root.findall(tag):
            _drop_joints(element, positions)
            if tag == "transmission" and element.find("joint") is None:
                root.remove(element)
    for element in [e for e in root if e.get("joint") in positions and "}" in str(e.tag)]:
        root.remove(element)  # homes and springs of held joints
    return tostring(root, encoding="unicode")


def _add_followers(joints: Mapping[str, Element], positions: dict[str, float]) -> None:
    """Add the positions of joints that mimic held ones, and those that mimic these."""
    for _ in joints:
        for name, element in joints.items():
            mimic = element.find("mimic")
            if mimic is not None and name not in positions and mimic.get("joint") in positions:
                share, offset = (
                    (parse_numbers(mimic.get(key, "")) or (default,))[0]
                    for key, default in (("multiplier", 1.0), ("offset", 0.0))
                )
                positions[name] = share * positions[mimic.get("joint", "")] + offset


def _fix(joint: Element, value: float, where: str) -> None:
    """Make a joint fixed at a position."""
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind not in (*_TURNS, "prismatic") and value:
        raise InputError(
            "unsupported", f"{where}: joint '{name}' is {kind}, with several degrees of freedom; hold it at 0"
        )
    axis = joint.find("axis")
    along = np.array(parse_numbers(axis.get("xyz", "")) if axis is not None else (1.0, 0.0, 0.0))
    length = float(np.linalg.norm(along)) if along.shape == (3,) else 0.0
    if length > 0 and value:
        _move_origin(joint, along / length, value, turns=kind in _TURNS)
    joint.set("type", "fixed")
    for tag in _DROPPED:
        for element in joint.findall(tag):
            joint.remove(element)


def _move_origin(joint: Element, axis: np.ndarray, value: float, *, turns: bool) -> None:
    """Compose the origin of a joint with its motion by a value along or about a unit axis (3,)."""
    origin = joint.find("origin")
    if origin is None:
        origin = Element("origin")
        joint.insert(0, origin)
    place, angles = (np.array(parse_numbers(origin.get(key, "0 0 0"))) for key in ("xyz", "rpy"))
    turn = build_rotation(angles)
    if turns:
        x, y, z = np.sin(value / 2) * axis
        turn = turn @ pin.Quaternion(np.cos(value / 2), x, y, z).matrix()
    else:
        place = place + turn @ (value * axis)
    for key, numbers in (("xyz", place), ("rpy", compute_rpy(turn))):
        origin.set(key, " ".join(repr(float(x)) for x in numbers))


def _drop_joints(element: Element, positions: Mapping[str, float]) -> None:
    """Remove the entries of held joints from a transmission or a control element."""
    for joint in element.findall("joint"):
        if joint.get("name") in positions:
            element.remove(joint)
