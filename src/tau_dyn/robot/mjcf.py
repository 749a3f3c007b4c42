"""Conversion of MJCF to URDF: the same bodies and joints, loops, couplings and motors.

`connect` becomes one ball, `weld` three; `equality/joint` becomes `<mimic>`. `damping`, `frictionloss` and `armature` become
the elements of URDF. MuJoCo's passive forces (springs, gravity compensation, fluid) and contacts are not part of a rigid robot:
they are left out, and those of joints are reported. `mjcf_tree.py` has the bodies.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot.floating_base import FREE_BODY
from tau_dyn.robot.mjcf_file import Item, MjcfFile
from tau_dyn.robot.mjcf_tree import MjcfTree, Place, format_numbers

_DRAKE, _OURS = "http://drake.mit.edu", "urn:tau_dyn"
_WELD_POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])  # [m] any three points off a line


def convert_mjcf(text: str, path: Path) -> str:
    """Return an MJCF file as URDF text.

    Args:
        text: The file.
        path: Path of the file; included files are searched in its folder.

    Raises:
        InputError: It has an element that a rigid robot with a fixed base cannot have; the message names the element.
    """
    file = MjcfFile(text, path)
    for prefix, space in (("drake", _DRAKE), ("tau_dyn", _OURS)):
        ElementTree.register_namespace(prefix, space)
    root = Element("robot", name=file.root.get("model") or path.name.split(".")[0])
    tree = MjcfTree(file, root)
    tree.build()
    for add in (_couple, _drive, _close_loops, _place_home):
        add(tree)
    for body in tree.free:
        link, sentence = tree.bodies[body].link, f"body '{body}' is free in the file; here it is fixed"
        SubElement(root, FREE_BODY, link=link)
        SubElement(root, f"{{{_OURS}}}warning", text=sentence, free_body=link)
    left_out = [f"left out: {what} {', '.join(names)}" for what, names in tree.left_out.items()]
    for sentence in [*tree.said, *left_out]:
        SubElement(root, f"{{{_OURS}}}warning", text=sentence)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _couple(tree: MjcfTree) -> None:
    for item in tree.list_equations("joint"):
        follower, leader = item.get("joint1"), item.get("joint2")
        if not leader:
            continue
        constant, slope = tree.read_polynomial(item)
        one, other = (tree.get_joint(name, item.where) for name in (follower, leader))
        offset = one.reference + constant - slope * other.reference
        if one.element.find("mimic") is not None:
            raise InputError("unsupported", f"{item.where}: joint '{follower}' follows two others")
        SubElement(one.element, "mimic", joint=leader, multiplier=format_numbers(slope), offset=format_numbers(offset))


def _drive(tree: MjcfTree) -> None:
    """Give the joints of actuators a transmission with their armature."""
    tendons = {e.get("name", ""): e for e in tree.file.sections("tendon")}
    for element in tree.file.sections("actuator"):
        item = tree.file.item(element)
        target = item.get("joint") or item.get("jointinparent")
        if not target and item.get("tendon"):
            target = _find_pulled(tree, tendons, item)
        elif not target and element.tag != "adhesion":
            raise InputError("unsupported", f"{item.where}: an actuator of a robot drives a joint")
        if not target:
            continue
        joint, gear = tree.get_joint(target, item.where), abs(float(item.numbers("gear", "1")[0]))
        joint.driven = True
        joint.armature += gear**2 * item.number("armature", 0.0)
        bounds = [item.limits("forcerange", "forcelimited")]
        bounds += [item.limits("ctrlrange", "ctrllimited")] if element.tag == "motor" else []
        known = [gear * float(np.abs(x).max()) for x in bounds if x is not None]
        joint.effort = min([*known, *([joint.effort] if joint.effort else [])], default=0.0)
    for name, joint in tree.joints.items():
        limit = joint.element.find("limit")
        assert limit is not None  # written with every joint
        limit.set("effort", format_numbers(joint.effort))
        if joint.driven or joint.element.find("mimic") is not None:
            _add_transmission(tree, name, joint.armature)
        elif joint.armature:
            tree.left_out.setdefault("armature of joints without motor", []).append(name)


def _find_pulled(tree: MjcfTree, tendons: dict[str, Element], item: Item) -> str:
    """Return the joint that a tendon's motor drives; empty, with a warning, if it drives several joints."""
    tendon = tendons.get(item.get("tendon"))
    if tendon is None or tendon.tag != "fixed":
        raise InputError("unsupported", f"{item.where}: tendon '{item.get('tendon')}' is not a fixed one, over joints")
    pulled = {_lead(tree, e.get("joint", ""), item.where) for e in tendon.findall("joint")}
    if len(pulled) == 1:
        return pulled.pop()
    listed = ", ".join(sorted(pulled))
    tree.said.append(f"tendon '{item.get('tendon')}' drives {listed} together; they count as without motor")
    return ""


def _lead(tree: MjcfTree, name: str, where: str) -> str:
    for _ in tree.joints:
        mimic = tree.get_joint(name, where).element.find("mimic")
        if mimic is None:
            break
        name = mimic.get("joint", "")
    return name


def _add_transmission(tree: MjcfTree, joint: str, armature: float) -> None:
    element = SubElement(tree.root, "transmission", name=f"{joint}_transmission")
    SubElement(element, "type").text = "transmission_interface/SimpleTransmission"
    SubElement(element, "joint", name=joint)
    actuator = SubElement(element, "actuator", name=f"{joint}_motor")
    SubElement(actuator, f"{{{_DRAKE}}}rotor_inertia", value=format_numbers(armature))
    SubElement(actuator, f"{{{_DRAKE}}}gear_ratio", value="1")


def _close_loops(tree: MjcfTree) -> None:
    for tag in {e.tag for e in tree.file.sections("equality")} - {"joint", "connect", "weld"}:
        if items := tree.list_equations(tag):
            raise InputError("unsupported", f"{items[0].where}: an equation of this kind is not read")
    for item in [*tree.list_equations("connect"), *tree.list_equations("weld")]:
        one, other = _find_ends(tree, item)
        if one.mocap or other.mocap:
            tree.said.append(f"the {item.tag} '{item.get('name')}' to a mocap body is left out")
            continue
        points = _list_points(tree, item, one, other)
        if one.link == other.link:
            continue
        for a, b in points:
            ball = SubElement(tree.root, f"{{{_DRAKE}}}ball_constraint")
            for end, place, point in (("A", one, a), ("B", other, b)):
                SubElement(ball, f"{{{_DRAKE}}}ball_constraint_body_{end}", name=place.link)
                key = {"A": "p_AP", "B": "p_BQ"}[end]
                SubElement(ball, f"{{{_DRAKE}}}ball_constraint_{key}", value=format_numbers(place.inside.place(point)))


def _find_ends(tree: MjcfTree, item: Item) -> tuple[Place, Place]:
    table, keys = (tree.sites, ("site1", "site2")) if item.get("site1") else (tree.bodies, ("body1", "body2"))
    found = []
    for key in keys:
        name = item.get(key, "world")
        if name not in table:
            raise InputError("robot_structure", f"{item.where}: {key}='{name}' is not in the file")
        found.append(table[name])
    return found[0], found[1]


def _list_points(tree: MjcfTree, item: Item, one: Place, other: Place) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return pairs of points, in the frames of both ends, that coincide."""
    if item.get("site1"):
        here = _WELD_POINTS if item.tag == "weld" else _WELD_POINTS[:1]
        return [(point, point) for point in here]
    apart = one.world.invert() @ other.world
    if item.tag == "connect":
        anchor = item.numbers("anchor", "", 3)
        return [(anchor, apart.invert().place(anchor))]
    relative = item.numbers("relpose", "0 1 0 0 0 0 0", 7)
    if relative[3:].any():
        turned = Item(
            "weld",
            {"pos": format_numbers(relative[:3]), "quat": format_numbers(relative[3:])},
            item.where,
            item.compiler,
        )
        apart = turned.pose()
    anchor = item.numbers("anchor", "0 0 0", 3)
    return [(apart.place(anchor + point), anchor + point) for point in _WELD_POINTS]


def _place_home(tree: MjcfTree) -> None:
    """Write the positions of the first keyframe called home, or of the first with positions, or those of the file."""
    keys = [tree.file.item(e) for e in tree.file.sections("keyframe") if e.get("qpos")]
    key = next((k for k in keys if k.get("name") == "home"), keys[0] if keys else None)
    count = sum(n for _, n in tree.positions)
    values = None if key is None else key.numbers("qpos", "")
    if values is not None and len(values) != count:
        tree.said.append(
            f"keyframe '{key.get('name') if key else ''}' has {len(values)} positions of {count}; it does not count"
        )
        values = None
    loops = tree.root.find(f"{{{_DRAKE}}}ball_constraint") is not None
    first = 0
    for name, n in tree.positions:
        value = None if values is None else float(values[first])
        first += n
        if name in tree.joints and (value is not None or loops):
            position = tree.joints[name].reference if value is None else value
            SubElement(tree.root, f"{{{_OURS}}}home", joint=name, value=format_numbers(position))
