"""A floating base as six joints without motors: a URDF text in which the robot's root moves freely, and its feet.

The base is placed in the world by three slides and three hinges, in this order,

    base_x, base_y, base_z [m],   base_yaw about z, base_pitch about y, base_roll about x [rad],   R = Rz(yaw) Ry(pitch) Rx(roll).

They are coordinates of one degree of freedom like all others, so every later step (tree, dynamics, regressor, saved model)
reads one file. Nothing drives them: their generalised force is zero. The angles are singular at a pitch of 90 degrees.
`legged/log_check.py` turns logged quaternions and body velocities, Pinocchio's coordinates of a free flyer, into these.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, register_namespace, tostring

from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot.numbers import parse_numbers

_OURS = "urn:tau_dyn"
_NAMESPACES = {"drake": "http://drake.mit.edu", "tau_dyn": _OURS}
BASE_COORDINATES = ("base_x", "base_y", "base_z", "base_yaw", "base_pitch", "base_roll")
"""Joints that place a floating base in the world, in the tree's order."""
_AXES = ("1 0 0", "0 1 0", "0 0 1", "0 0 1", "0 1 0", "1 0 0")
_ENDLESS = "1e12"  # [m] limit of a slide without limits
POINT, FLAT = "point", "flat"
FREE_BODY = f"{{{_OURS}}}free_body"
"""Element that names the link of an MJCF body with a free joint."""


@dataclass(frozen=True)
class ContactFrame:
    """A part of the robot that may touch the ground.

    Attributes:
        frame: Name of the link, as in the log's column `contact_FRAME`.
        kind: `point`: the ground exerts a force through one point; `flat`: a force and a moment.
        radius: Radius of a spherical foot [m]; the ground touches it at this distance below its centre.
        centre: The sphere's centre in the link's frame (3,) [m]; for other feet, the frame's origin.
    """

    frame: str
    kind: str = POINT
    radius: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


def free_base(urdf: str, contacts: Iterable[str], where: str) -> str:
    """Return URDF text with a floating base.

    Args:
        urdf: URDF text that `read_annotations` accepts.
        contacts: Links that may touch the ground: `FRAME` for a point foot, `FRAME=RADIUS` [m] for a ball about its origin,
            `FRAME=flat` for a flat foot.
        where: The robot's source, for messages.

    Raises:
        UnknownName: A contact is not a link.
        InputError: A contact is of another kind, or names of the file are those of the base's coordinates.
    """
    for prefix, uri in _NAMESPACES.items():
        register_namespace(prefix, uri)
    root = fromstring(urdf, forbid_dtd=True)
    links = {e.get("name", ""): e for e in root.findall("link")}
    taken = {e.get("name", "") for e in (*root.findall("link"), *root.findall("joint"))}
    clash = next((name for name in BASE_COORDINATES if name in taken), None)
    if clash is not None:
        raise InputError("robot_structure", f"{where}: '{clash}' is a coordinate of the floating base; rename it")
    for text in contacts:
        _add_contact(root, links, text, where)
    _add_coordinates(root, *_cut(root, links, taken, where))
    return tostring(root, encoding="unicode")


def remove_base_coordinates(root: Element) -> None:
    """Remove a floating base's coordinates and feet from URDF elements, so that its link is the root; the inverse of `free_base`.

    Other programs let a root without a joint float, or have a joint of their own for it.
    """
    joints = {e.get("name", ""): e for e in root.findall("joint")}
    removed = {_end(joints[name], end) for name in BASE_COORDINATES for end in ("parent", "child")}
    removed.remove(_end(joints[BASE_COORDINATES[-1]], "child"))
    for name in BASE_COORDINATES:
        root.remove(joints[name])
    for link in root.findall("link"):
        if link.get("name") in removed:
            root.remove(link)
    for tag in ("floating_base", "contact"):
        for element in root.findall(f"{{{_OURS}}}{tag}"):
            root.remove(element)


def _cut(root: Element, links: dict[str, Element], taken: set[str], where: str) -> tuple[str, str]:
    """Return the world's link and the base's, after removal of the joint between them."""
    joints = {_end(e, "child"): e for e in root.findall("joint")}
    roots = [name for name in links if name not in joints]
    freed = [e.get("link", "") for e in root.findall(FREE_BODY)]
    freed += [link for link, joint in joints.items() if joint.get("type") == "floating"]
    if len(freed) > 1 or len(roots) != 1:
        raise InputError(
            "robot_structure", f"{where}: one body floats; {', '.join(freed or roots)} would each be a floating base"
        )
    if not freed:
        world = next(name for name in ("world", "ground", "floating_base_ground") if name not in taken)
        root.insert(0, Element("link", name=world))
        return world, roots[0]
    root.remove(joints[freed[0]])
    for element in root.findall(f"{{{_OURS}}}warning"):
        if element.get("free_body"):
            root.remove(element)
    return _end(joints[freed[0]], "parent"), freed[0]


def _add_coordinates(root: Element, world: str, base: str) -> None:
    """Insert the six joints, connected by massless links, between world and base."""
    parent = world
    for name, axis in zip(BASE_COORDINATES, _AXES, strict=True):
        child = base if name == BASE_COORDINATES[-1] else f"{name}_link"
        slides = name in BASE_COORDINATES[:3]
        joint = SubElement(root, "joint", name=name, type="prismatic" if slides else "continuous")
        SubElement(joint, "parent", link=parent)
        SubElement(joint, "child", link=child)
        SubElement(joint, "axis", xyz=axis)
        limit = {"effort": "0", "velocity": "0"}
        if slides:
            limit |= {"lower": f"-{_ENDLESS}", "upper": _ENDLESS}
        SubElement(joint, "limit", limit)
        if child != base:
            SubElement(root, "link", name=child)
        parent = child
    SubElement(root, f"{{{_OURS}}}floating_base", link=base)


def _add_contact(root: Element, links: dict[str, Element], text: str, where: str) -> None:
    name, equals, kind = text.partition("=")
    if name not in links:
        raise UnknownName("link", name, list(links), where)
    radius = parse_numbers(kind)
    if equals and kind not in (POINT, FLAT) and not (len(radius) == 1 and 0 <= radius[0] < 1):
        raise InputError("bad_option", f"--contact {text}: write FRAME, FRAME=RADIUS in m, or FRAME=flat")
    said = {"link": name, "kind": FLAT if kind == FLAT else POINT}
    sphere = None if kind == FLAT else _find_sphere(links[name])
    if radius:
        said["radius"] = kind
    elif sphere is not None:
        said |= {"radius": sphere[0], "centre": sphere[1]}
    SubElement(root, f"{{{_OURS}}}contact", said)


def _find_sphere(link: Element) -> tuple[str, str] | None:
    """Return radius and centre of the single sphere in a link's collisions, or otherwise in its visuals."""
    for tag in ("collision", "visual"):
        found = [(shape, e) for e in link.findall(tag) if (shape := e.find("geometry/sphere")) is not None]
        if len(found) == 1:
            shape, element = found[0]
            origin = element.find("origin")
            centre = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
            if len(parse_numbers(shape.get("radius", ""))) == 1 and len(parse_numbers(centre)) == 3:
                return shape.get("radius", ""), centre
    return None


def _end(joint: Element, tag: str) -> str:
    element = joint.find(tag)
    return "" if element is None else element.get("link", "")
