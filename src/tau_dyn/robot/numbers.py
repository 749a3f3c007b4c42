"""Checks of the names and numbers of a robot file's tree, before it is read.

The parser that Pinocchio uses drops a whole `<inertial>` that it cannot read and continues with a link without mass; a NaN
passes through it into every force. It also reads numbers differently from Python, which reads `8_0` as eighty.

Rotations in the convention of robot files and of Pinocchio's reader: roll, pitch and yaw about fixed axes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from math import isfinite
from typing import Any
from xml.dom.minidom import Document
from xml.etree.ElementTree import Element

import numpy as np

from tau_dyn.exceptions import InputError

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_LIMITS = ("lower", "upper", "velocity", "effort")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_LIMITED = ("revolute", "prismatic")

MAX_NUMBER = 1e12
"""Bound of masses, inertias and positions [kg, kg m^2, m]; squares and sums of larger ones overflow. A larger limit means no
limit."""

MAX_LEVELS = 100
"""Largest number of levels of a robot file; parsers recurse by one call per level."""

MAX_LINKS = 1000
"""Largest number of links of a robot; Pinocchio's tables grow with their square."""


def check_depth(document: Document, where: str) -> None:
    """Reject a file with elements nested so deeply that a parser would overflow its stack.

    Raises:
        InputError: It names the file.
    """
    _refuse_deep(document.documentElement, lambda node: node.childNodes, where)


def check_tree(root: Element, where: str) -> None:
    """Reject a tree that is too deep or has too many links, as `check_depth` does for a document.

    Raises:
        InputError: It names the file.
    """
    _refuse_deep(root, list, where)
    links = len(root.findall("link"))
    if links > MAX_LINKS:
        raise InputError("robot_structure", f"{where}: {links} links; a robot has {MAX_LINKS} at most")


def _refuse_deep(root: Any, children: Callable[[Any], Iterable[Any]], where: str) -> None:
    level = [root]
    for _ in range(MAX_LEVELS):
        level = [child for node in level for child in children(node)]
        if not level:
            return
    raise InputError(
        "robot_structure",
        f"{where}: elements are nested more than {MAX_LEVELS} deep inside each other; a robot file has few levels",
    )


def check_parents(root: Element, where: str) -> None:
    """Reject links with two parents, and links that are their own ancestors.

    For the first, the parser builds a joint twice; it drops the second, with their mass, without a message.

    Raises:
        InputError: It names the link and its joints.
    """
    above: dict[str, tuple[str, str]] = {}  # link -> its joint, and that joint's parent
    for joint in root.findall("joint"):
        ends = [
            element.get("link", "") if (element := joint.find(tag)) is not None else "" for tag in ("parent", "child")
        ]
        name, (parent, child) = joint.get("name", ""), ends
        if child in above:
            raise InputError(
                "robot_structure",
                f"{where}: link '{child}' is the child of joints '{above[child][0]}' and '{name}'; a link has one, and loops are "
                "closed by <drake:ball_constraint>",
            )
        if child:
            above[child] = name, parent
    rooted: set[str] = set()
    for link in above:
        path: dict[str, str] = {}  # link -> its joint, on the way up
        while link in above and link not in rooted:
            if link in path:
                ring = list(path)[list(path).index(link) :]
                raise InputError(
                    "robot_structure", f"{where}: link '{link}' hangs on itself, by {', '.join(path[x] for x in ring)}"
                )
            path[link], link = above[link]
        rooted.update(path)


def check_names(elements: Iterable[Any], where: str) -> None:
    """Reject names that do not fit on a line: they are column headings of logs and parts of messages.

    Args:
        elements: Elements of an ElementTree or of a minidom document.
        where: The file.

    Raises:
        InputError: The message shows the name.
    """
    for element in elements:
        name = element.get("name") if isinstance(element, Element) else element.getAttribute("name")
        if name and not name.isprintable():
            tag = element.tag if isinstance(element, Element) else element.tagName
            raise InputError(
                "robot_structure",
                f"{where}: <{tag} name={name[:60]!r}>: a name holds no line breaks or control characters",
            )


def check_numbers(root: Element, where: str) -> None:
    """Reject masses, inertias, origins, axes and limits that are missing, not finite, or impossible for a joint.

    Raises:
        InputError: The message names the link or joint, the element and the values it must have.
    """
    for link in root.findall("link"):
        for inertial in link.findall("inertial"):
            place = f"{where}: link '{link.get('name', '')}'"
            _check(inertial, "mass", ("value",), 1, place, required=True)
            _check(inertial, "inertia", _INERTIA, 1, place, required=True)
            _check(inertial, "origin", ("xyz", "rpy"), 3, place)
            mass = inertial.find("mass")
            if mass is not None and float(mass.get("value", "")) < 0:
                raise InputError(
                    "robot_structure", f"{place}: its mass is {mass.get('value')} kg; a mass is not negative"
                )
    for joint in root.findall("joint"):
        place = f"{where}: joint '{joint.get('name', '')}'"
        _check(joint, "origin", ("xyz", "rpy"), 3, place)
        _check(joint, "axis", ("xyz",), 3, place)
        _check(joint, "limit", _LIMITS, 1, place, most=float("inf"))
        _check(joint, "dynamics", ("damping", "friction"), 1, place)
        _check_joint(joint, place)


def _check_joint(joint: Element, place: str) -> None:
    axis, limit, kind = joint.find("axis"), joint.find("limit"), joint.get("type")
    if kind != "fixed" and axis is not None and not any(parse_numbers(axis.get("xyz") or "1")):
        raise InputError("robot_structure", f"{place}: <axis xyz='{axis.get('xyz')}'> has no direction")
    if kind in _LIMITED and limit is not None:
        lower, upper = (float(limit.get(side) or 0.0) for side in ("lower", "upper"))
        if lower > upper:
            raise InputError(
                "robot_structure", f"{place}: <limit lower='{lower:g}' upper='{upper:g}'>: lower must not exceed upper"
            )


def check_inertia(mass: float, moments: Iterable[float], place: str) -> None:
    """Reject an inertia that no body can have: each principal moment is at least zero, and at most the sum of the other two.

    Args:
        mass: [kg].
        moments: The three principal moments about the centre [kg m^2].
        place: Beginning of the message.

    Raises:
        InputError: The message states the moments.
    """
    low, middle, high = sorted(moments)
    remedy = "correct them, or accept them as fitted with --fitted-inertias"
    said = f"{place}: its principal moments of inertia are {low:.4g}, {middle:.4g} and {high:.4g} kg m^2"
    if low < -_ROUNDING * high - _NO_MOMENT:
        raise InputError("robot_structure", f"{said}; none is negative in any body: {remedy}")
    if high > (1 + _ROUNDING) * (low + middle) + _NO_MOMENT:
        raise InputError(
            "robot_structure", f"{said}; in any body the largest is at most the sum of the others: {remedy}"
        )
    if not mass and high > _NO_MOMENT:
        raise InputError("robot_structure", f"{said}, and its mass is zero; give it one")


_ROUNDING = 0.01  # error of files with two digits
_NO_MOMENT = 1e-9  # [kg m^2] inertia of a grain


def _check(
    parent: Element,
    tag: str,
    names: tuple[str, ...],
    count: int,
    place: str,
    required: bool = False,
    most: float = MAX_NUMBER,
) -> None:
    element = parent.find(tag)
    if element is None:
        if required:
            raise InputError("robot_structure", f"{place}: <{parent.tag}> lacks <{tag}>")
        return
    for name in names:
        text = element.get(name)
        if text is None and not required:
            continue
        values = parse_numbers(text or "")
        if len(values) != count or not all(isfinite(value) and abs(value) <= most for value in values):
            size = "" if most > MAX_NUMBER else f" up to {most:g}"
            raise InputError(
                "robot_structure", f"{place}: <{tag} {name}='{text or ''}'> must hold {count} finite number(s){size}"
            )


def parse_numbers(text: str) -> tuple[float, ...]:
    """Return the numbers of a text, separated by blanks; empty if a word is not a number to every program."""
    words = [word for word in re.split(r"[ \t\r\n]+", text) if word]
    return tuple(map(float, words)) if all(map(_NUMBER.fullmatch, words)) else ()


def build_rotation(rpy: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of roll, pitch and yaw [rad] about the fixed axes x, y, z, in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def compute_rpy(rotation: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw [rad] of a rotation (3, 3), equally accurate near a pitch of 90 degrees."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1])
    return np.array([roll, pitch, yaw])


def combine_axes(along: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) whose x axis points along a direction (3,)."""
    x = np.asarray(along, float) / np.linalg.norm(along)
    across = np.cross(x, np.eye(3)[int(np.argmin(np.abs(x)))])
    y = across / np.linalg.norm(across)
    return np.stack([x, y, np.cross(x, y)], axis=1)
