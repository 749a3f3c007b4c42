"""From MJCF to the URDF that the rest reads: the same bodies and joints, loops, couplings and motors, with a fixed base.

A joint's frame sits at its anchor, with its body's axes. MuJoCo counts a joint from its `ref`, so a URDF joint's zero is turned back
by it and positions mean the same in both. `connect` becomes one ball, `weld` three; `equality/joint` becomes `<mimic>`; a passive
ball joint becomes three hinges. `damping`, `frictionloss` and `armature` go where URDF has them. What MuJoCo calls passive forces
(springs, gravity compensation, fluid) and contacts are no part of a rigid robot: they are left out, and those of joints are named.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot.mjcf_bodies import BodyMass, Shape, bound_mass, read_inertial, read_shape, sum_shapes
from tau_dyn.robot.mjcf_file import STILL, Item, MjcfFile, Pose, turn_about
from tau_dyn.robot.rotations import compute_rpy

_DRAKE, _OURS = "http://drake.mit.edu", "urn:tau_dyn"
_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2] Pinocchio's
_SHOWN_GROUPS = 2  # up to which MuJoCo's viewer shows geoms; collision shapes are usually in group 3
_ENDLESS = 1e12  # [m] a slide's limit where it has none
_WELD_POINTS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])  # [m] any three off a line
_NOT_READ = ("replicate", "composite", "flexcomp", "attach")
_ROUNDED = 1e-9  # [m or rad] of a coefficient or position that is meant to be zero


@dataclass
class _Joint:
    """A hinge or slide: its item, and what equations, motors and the home position add to it."""

    item: Item
    element: Element
    armature: float
    reference: float
    effort: float = 0.0
    driven: bool = False


@dataclass
class _Place:
    """A body: its link, its frame in that link's, and in the world where all joints are at their reference."""

    link: str
    inside: Pose
    world: Pose
    mocap: bool = False


@dataclass
class _Converter:
    """Builds the URDF of one file."""

    file: MjcfFile
    root: Element
    joints: dict[str, _Joint] = field(default_factory=dict)
    bodies: dict[str, _Place] = field(default_factory=dict)
    sites: dict[str, _Place] = field(default_factory=dict)
    positions: list[tuple[str, int]] = field(
        default_factory=list
    )  # joints in the order of MuJoCo's qpos, and their numbers
    locked: dict[str, float] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)
    said: list[str] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def build(self) -> None:
        """Fill the URDF."""
        self._check_settings()
        self.names = {
            e.get("name", "") for section in self.file.root.findall("worldbody") for e in section.iter("joint")
        }
        self._find_locked()
        SubElement(self.root, "link", name=self._own("world"))
        world = _Place("world", STILL, STILL)
        self.bodies["world"] = world
        for section in self.file.root.findall("worldbody"):
            for child, frame, child_class in self._inside(section, STILL, ""):
                if child.tag == "body":
                    self._add_body(child, world, frame, child_class, moving=False)
                elif child.tag == "site":
                    self._add_site(child, world, frame, child_class)
        self._couple()
        self._drive()
        self._close_loops()
        self._place_home()
        self.said += [f"left out: {what} {', '.join(names)}" for what, names in self.left_out.items()]
        for sentence in self.said:
            SubElement(self.root, f"{{{_OURS}}}warning", text=sentence)

    def _check_settings(self) -> None:
        where, compiler = self.file.where, self.file.compiler
        for option in self.file.root.findall("option"):
            gravity = self.file.item(option).numbers("gravity", "0 0 -9.81", 3)
            if not np.array_equal(gravity, _GRAVITY):
                raise InputError(
                    "unsupported",
                    f"{where}: <option gravity='{option.get('gravity')}'>: robots are read with 0 0 -9.81",
                )
        for key, allowed in (("coordinate", "local"), ("settotalmass", "-1")):
            if compiler.get(key, allowed) != allowed:
                raise InputError("unsupported", f"{where}: <compiler {key}='{compiler[key]}'> is not read")
        for section in self.file.root.findall("worldbody"):
            for tag in _NOT_READ:
                if (found := next(section.iter(tag), None)) is not None:
                    name = found.get("name") or found.get("prefix") or found.get("model") or ""
                    raise InputError("unsupported", f"{where}: <{tag} '{name}'> is not read; write its bodies out")

    def _inside(self, element: Element, frame: Pose, child_class: str) -> Iterator[tuple[Element, Pose, str]]:
        """Yield the elements in a body, with the `<frame>` that each stands in and its class."""
        for child in element:
            if child.tag == "frame":
                item = self.file.item(child, child_class)
                yield from self._inside(child, frame @ item.pose(), child.get("childclass", child_class))
            else:
                yield child, frame, child_class

    def _add_body(self, element: Element, parent: _Place, frame: Pose, child_class: str, *, moving: bool) -> None:
        child_class = element.get("childclass", child_class)
        item = self.file.item(element, child_class)
        name = element.get("name") or f"body{len(self.bodies)}"
        if name in self.bodies:
            raise InputError("robot_structure", f"{self.file.where}: two bodies are called '{name}'")
        pose = frame @ item.pose()
        inside, parent_link = parent.inside @ pose, parent.link
        parts = list(self._inside(element, STILL, child_class))
        place = _Place("", inside, parent.world @ pose, element.get("mocap") == "true")
        self.bodies[name] = place
        rows = [
            row for child, own, its_class in parts if child.tag in ("joint", "freejoint")
            for row in self._list_joints(child, own, its_class, name)
        ]  # fmt: skip
        last = len([1 for _, kind, *_ in rows if kind])
        for joint, kind, anchor, axis in rows:
            reference = self._read_reference(joint, kind)
            if not kind:  # held where an equation puts it
                inside = inside @ _move(
                    joint.get("type", "hinge"), anchor, axis, self.locked[joint.get("name")] - reference
                )
                continue
            last -= 1
            link = self._own(name) if last == 0 else self._own(f"{name}_{joint.get('name')}_link")
            origin = inside @ Pose(np.eye(3), anchor) @ _move(kind, np.zeros(3), axis, -reference)
            self._add_link(link, joint.get("name"), kind, parent_link, origin)
            self._describe_joint(joint, kind, axis, reference)
            inside, parent_link = Pose(np.eye(3), -anchor), link
        moves = any(kind for _, kind, *_ in rows)
        if not moves:
            parent_link, origin, inside = self._own(name), inside, STILL
            self._add_link(parent_link, f"{parent_link}_fixed", "fixed", parent.link, origin)
        place.link, place.inside = parent_link, inside
        self._add_mass(item, parts, place, moving or moves)
        for child, own, its_class in parts:
            if child.tag == "site":
                self._add_site(child, place, own, its_class)
            elif child.tag == "body":
                self._add_body(child, place, own, its_class, moving=moving or moves)

    def _list_joints(
        self, element: Element, frame: Pose, child_class: str, body: str
    ) -> list[tuple[Item, str, np.ndarray, np.ndarray]]:
        """Return a joint as hinges and slides: item, kind (none for one held still), anchor and axis in the body's frame."""
        item = self.file.item(element, child_class)
        kind = "free" if element.tag == "freejoint" else item.get("type", "hinge")
        name = item.get("name") or f"{body}_joint{len(self.positions) + 1}"
        if kind == "free":
            self.positions.append((name, 7))
            self.said.append(f"body '{body}' is free in the file; here it stands still")
            return []
        anchor = frame.place(item.numbers("pos", "0 0 0", 3))
        axis = frame.rotation @ item.numbers("axis", "0 0 1", 3)
        if kind == "ball":
            self.positions.append((name, 4))
            self.said.append(f"ball joint '{name}' is read as three hinges, {name}_x {name}_y {name}_z")
            hinges = [(f"{name}_{x}", frame.rotation[:, k]) for k, x in enumerate("xyz")]
            still = {"pos": "0 0 0", "type": "hinge", "range": "0 0", "ref": "0", "armature": item.get("armature", "0")}
            return [
                (Item("joint", {**still, "name": one}, item.where, item.compiler), "hinge", anchor, x)
                for one, x in hinges
            ]
        if kind not in ("hinge", "slide"):
            raise InputError("robot_structure", f"{item.where}: there is no joint of type '{kind}'")
        if np.linalg.norm(axis) < 1e-10:  # MuJoCo's own bound
            raise InputError("robot_structure", f"{item.where}: axis='{item.get('axis')}' has no direction")
        self.positions.append((name, 1))
        named = Item("joint", {**item.values, "name": name}, item.where, item.compiler)
        return [(named, "" if name in self.locked else kind, anchor, axis / np.linalg.norm(axis))]

    def _read_reference(self, joint: Item, kind: str) -> float:
        value = joint.number("ref", 0.0)
        return value if (kind or joint.get("type", "hinge")) == "slide" else joint.angle(value)

    def _add_link(self, link: str, joint: str, kind: str, parent: str, origin: Pose) -> None:
        SubElement(self.root, "link", name=link)
        types = {"fixed": "fixed", "hinge": "revolute", "slide": "prismatic"}
        element = SubElement(self.root, "joint", name=joint, type=types[kind])
        SubElement(element, "parent", link=parent)
        SubElement(element, "child", link=link)
        SubElement(element, "origin", xyz=_text(origin.origin), rpy=_text(compute_rpy(origin.rotation)))

    def _describe_joint(self, item: Item, kind: str, axis: np.ndarray, reference: float) -> None:
        name, element = item.get("name"), self.root[-1]
        if name in self.joints:
            raise InputError("robot_structure", f"{self.file.where}: two joints are called '{name}'")
        SubElement(element, "axis", xyz=_text(axis))
        bounds = item.limits("range", "limited")
        if bounds is not None and kind == "hinge":
            bounds = np.array([item.angle(x) for x in bounds])
        if bounds is None and kind == "hinge":
            element.set("type", "continuous")
        lower, upper = (-_ENDLESS, _ENDLESS) if bounds is None else bounds
        friction = {"damping": item.numbers("damping", "0")[0], "friction": item.number("frictionloss", 0.0)}
        SubElement(element, "dynamics", {key: _text(value) for key, value in friction.items()})
        force = item.limits("actuatorfrcrange", "actuatorfrclimited")
        effort = 0.0 if force is None else float(np.abs(force).max())
        limit = {"effort": effort, "velocity": 0.0, "lower": lower, "upper": upper}
        SubElement(element, "limit", {key: _text(value) for key, value in limit.items()})
        self.joints[name] = _Joint(item, element, item.number("armature", 0.0), reference, effort)
        if any(item.numbers("stiffness", "0")):
            self.left_out.setdefault("springs of joints", []).append(name)

    def _add_mass(self, item: Item, parts: list[tuple[Element, Pose, str]], place: _Place, moving: bool) -> None:
        link, compiler = self.root.find(f"link[@name='{place.link}']"), self.file.compiler
        if link is None:
            raise InputError("robot_structure", f"{item.where}: no name of a body")
        shapes = [
            read_shape(self.file.item(child, its_class), own) for child, own, its_class in parts if child.tag == "geom"
        ]
        mode, where = compiler.get("inertiafromgeom", "auto"), item.where
        given = next((child for child, *_ in parts if child.tag == "inertial"), None)
        body = BodyMass(0.0, np.zeros(3), np.zeros((3, 3)))
        if given is not None and mode != "true":
            body = read_inertial(Item("inertial", dict(given.attrib), f"{where}: <inertial>", compiler))
        elif mode != "false" and moving:
            settings = Item("compiler", compiler, f"{self.file.where}: <compiler>", compiler)
            low, high = settings.numbers("inertiagrouprange", "0 5", 2)
            body = sum_shapes(shapes, (low, high), where)
        if moving:
            settings = Item("compiler", compiler, f"{self.file.where}: <compiler>", compiler)
            least = settings.number("boundmass", 0.0), settings.number("boundinertia", 0.0)
            body = bound_mass(body, *least, compiler.get("balanceinertia", "false") == "true")
        if body.mass:
            inertia = place.inside.rotation @ body.inertia @ place.inside.rotation.T
            inertial = SubElement(link, "inertial")
            SubElement(inertial, "origin", xyz=_text(place.inside.place(body.centre)), rpy="0 0 0")
            SubElement(inertial, "mass", value=_text(body.mass))
            entries = {f"i{'xyz'[i]}{'xyz'[j]}": _text(inertia[i, j]) for i in range(3) for j in range(i, 3)}
            SubElement(inertial, "inertia", entries)
        for shape in shapes:
            _draw(link, shape, place.inside)
        if item.number("gravcomp", 0.0):
            self.left_out.setdefault("gravity compensation of bodies", []).append(item.get("name"))

    def _add_site(self, element: Element, place: _Place, frame: Pose, child_class: str) -> None:
        name = element.get("name")
        if not name:
            return
        pose = frame @ self.file.item(element, child_class).pose()
        link = self._own(name if name not in self.bodies else f"{name}_site")
        self._add_link(link, f"{link}_fixed", "fixed", place.link, place.inside @ pose)
        self.sites[name] = _Place(place.link, place.inside @ pose, place.world @ pose)

    def _own(self, name: str) -> str:
        """Return a link's name that no joint and no other link has."""
        while name in self.names:
            name = f"{name}_link"
        self.names.add(name)
        return name

    def _equations(self, tag: str) -> list[Item]:
        items = [self.file.item(e) for e in self.file.sections("equality") if e.tag == tag]
        defaults = self.file.defaults["main"].get("equality", {})
        return [item for item in items if item.get("active", defaults.get("active", "true")) != "false"]

    def _read_polynomial(self, item: Item) -> tuple[float, float]:
        """Return constant and slope of one joint's position over another's; further terms are refused."""
        polynomial = item.numbers("polycoef", "0 1 0 0 0")
        if np.abs(polynomial[2:]).max(initial=0.0) > _ROUNDED:
            raise InputError(
                "unsupported",
                f"{item.where} of joint1='{item.get('joint1')}': polycoef='{item.get('polycoef')}' is not linear",
            )
        return float(polynomial[0]), float(polynomial[1]) if len(polynomial) > 1 else 0.0

    def _find_locked(self) -> None:
        """Find the joints that an equation holds still."""
        held = {
            item.get("joint1"): self._read_polynomial(item)[0]
            for item in self._equations("joint")
            if not item.get("joint2")
        }
        for section in self.file.root.findall("worldbody"):
            for joint, child_class in _iterate_joints(section, ""):
                if joint.get("name") in held:
                    item = self.file.item(joint, child_class)
                    self.locked[joint.get("name", "")] = held[joint.get("name")] + self._read_reference(item, "")

    def _couple(self) -> None:
        for item in self._equations("joint"):
            follower, leader = item.get("joint1"), item.get("joint2")
            if not leader:
                continue
            constant, slope = self._read_polynomial(item)
            one, other = (self._joint(name, item.where) for name in (follower, leader))
            offset = one.reference + constant - slope * other.reference
            if one.element.find("mimic") is not None:
                raise InputError("unsupported", f"{item.where}: joint '{follower}' follows two others")
            SubElement(one.element, "mimic", joint=leader, multiplier=_text(slope), offset=_text(offset))

    def _joint(self, name: str, where: str) -> _Joint:
        if name not in self.joints:
            raise InputError(
                "robot_structure",
                f"{where}: '{name}' is no hinge or slide that moves; there are {', '.join(self.joints)}",
            )
        return self.joints[name]

    def _drive(self) -> None:
        """Give the joints of actuators a transmission with their armature."""
        tendons = {e.get("name", ""): e for e in self.file.sections("tendon")}
        for element in self.file.sections("actuator"):
            item = self.file.item(element)
            target = item.get("joint") or item.get("jointinparent")
            if not target and item.get("tendon"):
                target = self._find_pulled(tendons, item)
            elif not target and element.tag != "adhesion":
                raise InputError("unsupported", f"{item.where}: an actuator of a robot drives a joint")
            if not target:
                continue
            joint, gear = self._joint(target, item.where), abs(float(item.numbers("gear", "1")[0]))
            joint.driven = True
            joint.armature += gear**2 * item.number("armature", 0.0)
            bounds = [item.limits("forcerange", "forcelimited")]
            bounds += [item.limits("ctrlrange", "ctrllimited")] if element.tag == "motor" else []
            known = [gear * float(np.abs(x).max()) for x in bounds if x is not None]
            joint.effort = min([*known, *([joint.effort] if joint.effort else [])], default=0.0)
        for name, joint in self.joints.items():
            limit = joint.element.find("limit")
            assert limit is not None  # written with every joint
            limit.set("effort", _text(joint.effort))
            if joint.driven or joint.element.find("mimic") is not None:
                self._add_transmission(name, joint.armature)
            elif joint.armature:
                self.left_out.setdefault("armature of joints without motor", []).append(name)

    def _find_pulled(self, tendons: dict[str, Element], item: Item) -> str:
        """Return the joint that a tendon's motor drives in the end; none, with a warning, where it pulls several."""
        tendon = tendons.get(item.get("tendon"))
        if tendon is None or tendon.tag != "fixed":
            raise InputError(
                "unsupported", f"{item.where}: tendon '{item.get('tendon')}' is not a fixed one, over joints"
            )
        pulled = {self._lead(e.get("joint", ""), item.where) for e in tendon.findall("joint")}
        if len(pulled) == 1:
            return pulled.pop()
        listed = ", ".join(sorted(pulled))
        self.said.append(f"tendon '{item.get('tendon')}' drives {listed} together; they count as without motor")
        return ""

    def _lead(self, name: str, where: str) -> str:
        for _ in self.joints:
            mimic = self._joint(name, where).element.find("mimic")
            if mimic is None:
                break
            name = mimic.get("joint", "")
        return name

    def _add_transmission(self, joint: str, armature: float) -> None:
        element = SubElement(self.root, "transmission", name=f"{joint}_transmission")
        SubElement(element, "type").text = "transmission_interface/SimpleTransmission"
        SubElement(element, "joint", name=joint)
        actuator = SubElement(element, "actuator", name=f"{joint}_motor")
        SubElement(actuator, f"{{{_DRAKE}}}rotor_inertia", value=_text(armature))
        SubElement(actuator, f"{{{_DRAKE}}}gear_ratio", value="1")

    def _close_loops(self) -> None:
        for tag in {e.tag for e in self.file.sections("equality")} - {"joint", "connect", "weld"}:
            if items := self._equations(tag):
                raise InputError("unsupported", f"{items[0].where}: an equation of this kind is not read")
        for item in [*self._equations("connect"), *self._equations("weld")]:
            one, other = self._find_ends(item)
            if one.mocap or other.mocap:
                self.said.append(f"the {item.tag} '{item.get('name')}' to a mocap body is left out")
                continue
            points = self._list_points(item, one, other)
            if one.link == other.link:
                continue
            for a, b in points:
                ball = SubElement(self.root, f"{{{_DRAKE}}}ball_constraint")
                for end, place, point in (("A", one, a), ("B", other, b)):
                    SubElement(ball, f"{{{_DRAKE}}}ball_constraint_body_{end}", name=place.link)
                    key = {"A": "p_AP", "B": "p_BQ"}[end]
                    SubElement(ball, f"{{{_DRAKE}}}ball_constraint_{key}", value=_text(place.inside.place(point)))

    def _find_ends(self, item: Item) -> tuple[_Place, _Place]:
        table, keys = (self.sites, ("site1", "site2")) if item.get("site1") else (self.bodies, ("body1", "body2"))
        found = []
        for key in keys:
            name = item.get(key, "world")
            if name not in table:
                raise InputError("robot_structure", f"{item.where}: {key}='{name}' is not in the file")
            found.append(table[name])
        return found[0], found[1]

    def _list_points(self, item: Item, one: _Place, other: _Place) -> list[tuple[np.ndarray, np.ndarray]]:
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
            turned = Item("weld", {"pos": _text(relative[:3]), "quat": _text(relative[3:])}, item.where, item.compiler)
            apart = turned.pose()
        anchor = item.numbers("anchor", "0 0 0", 3)
        return [(apart.place(anchor + point), anchor + point) for point in _WELD_POINTS]

    def _place_home(self) -> None:
        """Write the positions of the first keyframe called home, else of the first with positions, else those of the file."""
        keys = [self.file.item(e) for e in self.file.sections("keyframe") if e.get("qpos")]
        key = next((k for k in keys if k.get("name") == "home"), keys[0] if keys else None)
        count = sum(n for _, n in self.positions)
        values = None if key is None else key.numbers("qpos", "")
        if values is not None and len(values) != count:
            self.said.append(
                f"keyframe '{key.get('name') if key else ''}' has {len(values)} positions of {count}; it does not count"
            )
            values = None
        loops = self.root.find(f"{{{_DRAKE}}}ball_constraint") is not None
        first = 0
        for name, n in self.positions:
            value = None if values is None else float(values[first])
            first += n
            if name in self.joints and (value is not None or loops):
                position = self.joints[name].reference if value is None else value
                SubElement(self.root, f"{{{_OURS}}}home", joint=name, value=_text(position))


def convert_mjcf(text: str, path: Path) -> str:
    """Return an MJCF file as URDF text.

    Args:
        text: The file.
        path: Where it lies; what it includes is looked for beside it.

    Raises:
        InputError: It holds what a rigid robot with a fixed base cannot have; the sentence names the element.
    """
    file = MjcfFile.read(text, path)
    for prefix, space in (("drake", _DRAKE), ("tau_dyn", _OURS)):
        ElementTree.register_namespace(prefix, space)
    root = Element("robot", name=file.root.get("model") or path.name.split(".")[0])
    _Converter(file, root).build()
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _iterate_joints(element: Element, child_class: str) -> Iterator[tuple[Element, str]]:
    for child in element:
        if child.tag == "joint":
            yield child, child_class
        else:
            yield from _iterate_joints(child, child.get("childclass", child_class))


def _move(kind: str, anchor: np.ndarray, axis: np.ndarray, position: float) -> Pose:
    """Return a joint's motion of its body (hinge or slide) from its reference, in the body's frame."""
    if kind == "slide":
        return Pose(np.eye(3), position * axis)
    turn = turn_about(axis, position)
    return Pose(turn, anchor - turn @ anchor)


def _draw(link: Element, shape: Shape, inside: Pose) -> None:
    """Add a shape to a link's picture; URDF has no capsule, whose tube alone is drawn, and no ellipsoid."""
    group = int(shape.item.number("group", 0.0))
    if group > _SHOWN_GROUPS or shape.kind not in ("box", "sphere", "cylinder", "capsule"):
        return
    visual = SubElement(link, "visual")
    pose = inside @ shape.pose
    SubElement(visual, "origin", xyz=_text(pose.origin), rpy=_text(compute_rpy(pose.rotation)))
    geometry, (x, _, z) = SubElement(visual, "geometry"), shape.size
    if shape.kind == "box":
        SubElement(geometry, "box", size=_text(2 * shape.size))
    elif shape.kind == "sphere":
        SubElement(geometry, "sphere", radius=_text(x))
    else:
        SubElement(geometry, "cylinder", radius=_text(x), length=_text(2 * z))


def _text(values: float | Iterable[float]) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(np.asarray(values, float)))
