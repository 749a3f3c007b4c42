"""The numbers of a robot file's tree, checked before anybody reads them.

The parser that Pinocchio uses drops a whole `<inertial>` that it cannot read and goes on with a link without mass; a NaN passes
through it into every force.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import isfinite
from typing import Any
from xml.dom.minidom import Document
from xml.etree.ElementTree import Element

from tau_dyn.exceptions import InputError

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_LIMITS = ("lower", "upper", "velocity", "effort")


MAX_LEVELS = 100
"""Levels of a robot file; parsers go down one call a level."""

MAX_LINKS = 1000
"""Links of a robot; Pinocchio's tables grow with their square."""


def check_depth(document: Document, where: str) -> None:
    """Refuse a file with elements so deep inside each other that a parser would use up its stack.

    Raises:
        InputError: It names the file.
    """
    _refuse_deep(document.documentElement, lambda node: node.childNodes, where)


def check_tree(root: Element, where: str) -> None:
    """Refuse a tree too deep or of too many links, as `check_depth` does for a document.

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
        f"{where}: elements stand more than {MAX_LEVELS} deep inside each other; a robot file has few levels",
    )


def check_parents(root: Element, where: str) -> None:
    """Refuse links with two parents, and links that hang on themselves.

    The parser builds a joint twice for the one and forgets the other, mass and all, in silence.

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


def check_numbers(root: Element, where: str) -> None:
    """Refuse masses, inertias, origins, axes and limits that are missing or not finite numbers.

    Raises:
        InputError: The message names the link or joint, the element and what it must hold.
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
        _check(joint, "limit", _LIMITS, 1, place)


def _check(parent: Element, tag: str, names: tuple[str, ...], count: int, place: str, required: bool = False) -> None:
    element = parent.find(tag)
    if element is None:
        if required:
            raise InputError("robot_structure", f"{place}: <{parent.tag}> lacks <{tag}>")
        return
    for name in names:
        text = element.get(name)
        if text is None and not required:
            continue
        if not _are_numbers(text or "", count):
            raise InputError(
                "robot_structure", f"{place}: <{tag} {name}='{text or ''}'> must hold {count} finite number(s)"
            )


def _are_numbers(text: str, count: int) -> bool:
    values = parse_numbers(text)
    return len(values) == count and all(map(isfinite, values))


def parse_numbers(text: str) -> tuple[float, ...]:
    """Return the numbers that a text lists between blanks; none where one word is no number."""
    try:
        return tuple(float(word) for word in text.split())
    except ValueError:
        return ()
