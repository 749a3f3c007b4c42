"""The bodies, joints and sites of an MJCF file as links and joints of a URDF, with a fixed base.

A joint's frame is at its anchor, with its body's axes. MuJoCo counts a joint's position from its `ref`, so the zero of the URDF
joint is shifted back by `ref`, and positions mean the same in both. A passive ball joint becomes three hinges.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot.mesh_inertia import FORMS, measure_mesh, read_triangles
from tau_dyn.robot.mjcf_bodies import BodyMass, Geom, bound_mass, read_inertial, read_shape, sum_shapes
from tau_dyn.robot.mjcf_file import STILL, Item, MjcfFile, Transform, turn_about
from tau_dyn.robot.numbers import MAX_LINKS, compute_rpy

_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2] Pinocchio's
_MAX_GRAVITY_DIFFERENCE = 0.03
"""Difference of a file's gravity that counts as rounding or as its place on earth, where it is 9.78 to 9.83 [m/s^2]."""
_SHOWN_GROUPS = 2  # up to which MuJoCo's viewer shows geoms; collision shapes are usually in group 3
_ENDLESS = 1e12  # [m] limit of a slide without limits
_NOT_READ = ("replicate", "composite", "flexcomp", "attach")
_ROUNDED = 1e-9  # tolerance of a coefficient that is meant to be zero


class MjcfJoint:
    """A hinge or slide: its MJCF item, its URDF element, and the data that motors and equations add to it.

    Attributes:
        item: The element in the file.
        element: Its `<joint>` in the URDF.
        armature: [kg or kg m^2].
        reference: Its position in the pose of the file [m or rad].
        effort: Limit of its force [N or N m]; zero if unlimited.
        driven: Whether a motor drives it.
    """

    def __init__(self, item: Item, element: Element, armature: float, reference: float, effort: float = 0.0) -> None:
        """Begin with the values of the joint's own element."""
        self.item, self.element, self.armature, self.reference, self.effort = item, element, armature, reference, effort
        self.driven = False


@dataclass(frozen=True, eq=False)
class Place:
    """A body or site: its link, its frame in that link's frame, and in the world with all joints at their reference."""

    link: str
    inside: Transform
    world: Transform
    mocap: bool = False


class MjcfTree:
    """Builds the links of one file and reports the elements that it leaves out.

    Attributes:
        file: The file.
        root: The URDF's `<robot>`.
        joints: Hinges and slides by name.
        bodies: Bodies by name, the world included.
        sites: Sites by name.
        positions: The joints in the order of MuJoCo's `qpos`, with their number of entries.
        said: Sentences about elements that are read with another meaning.
        free: Bodies with a free joint.
        left_out: Elements that are left out, with their joints or bodies.
    """

    def __init__(self, file: MjcfFile, root: Element) -> None:
        """Begin with an empty `<robot>`."""
        self.file, self.root = file, root
        self.joints: dict[str, MjcfJoint] = {}
        self.bodies: dict[str, Place] = {}
        self.sites: dict[str, Place] = {}
        self.positions: list[tuple[str, int]] = []
        self.said: list[str] = []
        self.free: list[str] = []
        self.left_out: dict[str, list[str]] = {}
        self._locked: dict[str, float] = {}
        self._names: set[str] = set()
        self._links: dict[str, Element] = {}

    def build(self) -> None:
        """Add all links and joints to the URDF."""
        self._check_settings()
        worlds = self.file.root.findall("worldbody")
        self._names = {e.get("name", "") for section in worlds for e in section.iter("joint")}
        self._find_locked()
        base = self._own("world")
        self._links[base] = SubElement(self.root, "link", name=base)
        world = self.bodies["world"] = Place(base, STILL, STILL)
        for section in worlds:
            for child, frame, child_class in self._inside(section, STILL, ""):
                if child.tag == "body":
                    self._add_body(child, world, frame, child_class, moving=False)
                elif child.tag == "site":
                    self._add_site(child, world, frame, child_class)
                elif child.tag == "geom":
                    self._draw(self._links[base], read_shape(self.file.item(child, child_class), frame), STILL)

    def list_equations(self, tag: str) -> list[Item]:
        """Return the active equations of a kind."""
        items = [self.file.item(e) for e in self.file.sections("equality") if e.tag == tag]
        defaults = self.file.defaults["main"].get("equality", {})
        return [item for item in items if item.get("active", defaults.get("active", "true")) != "false"]

    def get_joint(self, name: str, where: str) -> MjcfJoint:
        """Return a hinge or slide that moves.

        Raises:
            InputError: There is no moving joint of this name.
        """
        if name not in self.joints:
            raise InputError(
                "robot_structure",
                f"{where}: '{name}' is no hinge or slide that moves; there are {', '.join(self.joints)}",
            )
        return self.joints[name]

    def read_polynomial(self, item: Item) -> tuple[float, float]:
        """Return constant and slope of one joint's position over another's; further terms raise."""
        polynomial = item.numbers("polycoef", "0 1 0 0 0")
        if np.abs(polynomial[2:]).max(initial=0.0) > _ROUNDED:
            raise InputError(
                "unsupported",
                f"{item.where} of joint1='{item.get('joint1')}': polycoef='{item.get('polycoef')}' is not linear",
            )
        return float(polynomial[0]), float(polynomial[1]) if len(polynomial) > 1 else 0.0

    def _check_settings(self) -> None:
        where, compiler = self.file.where, self.file.compiler
        for option in self.file.root.findall("option"):
            gravity = self.file.item(option).numbers("gravity", "0 0 -9.81", 3)
            if np.linalg.norm(gravity - _GRAVITY) > _MAX_GRAVITY_DIFFERENCE:
                raise InputError(
                    "unsupported",
                    f"{where}: <option gravity='{option.get('gravity')}'>: robots are read with 0 0 -9.81; for a robot "
                    "on a wall or a slope, turn its first body",
                )
        for key, allowed in (("coordinate", "local"), ("settotalmass", "-1")):
            if compiler.get(key, allowed) != allowed:
                raise InputError("unsupported", f"{where}: <compiler {key}='{compiler[key]}'> is not read")
        bodies = sum(len(list(section.iter("body"))) for section in self.file.root.findall("worldbody"))
        if bodies > MAX_LINKS:
            raise InputError("robot_structure", f"{where}: {bodies} bodies; a robot has {MAX_LINKS} at most")
        for section in self.file.root.findall("worldbody"):
            for tag in _NOT_READ:
                if (found := next(section.iter(tag), None)) is not None:
                    name = found.get("name") or found.get("prefix") or found.get("model") or ""
                    raise InputError("unsupported", f"{where}: <{tag} '{name}'> is not read; write its bodies out")

    def _inside(self, element: Element, frame: Transform, child_class: str) -> Iterator[tuple[Element, Transform, str]]:
        """Yield the elements of a body, each with the `<frame>` that contains it and its class."""
        for child in element:
            if child.tag == "frame":
                item = self.file.item(child, child_class)
                yield from self._inside(child, frame @ item.pose(), child.get("childclass", child_class))
            else:
                yield child, frame, child_class

    def _add_body(self, element: Element, parent: Place, frame: Transform, child_class: str, *, moving: bool) -> None:
        child_class = element.get("childclass", child_class)
        item = self.file.item(element, child_class)
        name = element.get("name") or f"body{len(self.bodies)}"
        if name in self.bodies:
            raise InputError("robot_structure", f"{self.file.where}: two bodies are called '{name}'")
        pose = frame @ item.pose()
        inside, parent_link = parent.inside @ pose, parent.link
        parts = list(self._inside(element, STILL, child_class))
        rows = [
            row for child, own, its_class in parts if child.tag in ("joint", "freejoint")
            for row in self._list_joints(child, own, its_class, name)
        ]  # fmt: skip
        last = len([1 for _, kind, *_ in rows if kind])
        for joint, kind, anchor, axis in rows:
            reference = self._read_reference(joint, kind)
            if not kind:  # fixed at the position of an equation
                inside = inside @ _move(
                    joint.get("type", "hinge"), anchor, axis, self._locked[joint.get("name")] - reference
                )
                continue
            last -= 1
            link = self._own(name) if last == 0 else self._own(f"{name}_{joint.get('name')}_link")
            origin = inside @ Transform(np.eye(3), anchor) @ _move(kind, np.zeros(3), axis, -reference)
            self._add_link(link, joint.get("name"), kind, parent_link, origin)
            self._describe_joint(joint, kind, axis, reference)
            inside, parent_link = Transform(np.eye(3), -anchor), link
        moves = any(kind for _, kind, *_ in rows)
        if not moves:
            parent_link, origin, inside = self._own(name), inside, STILL
            self._add_link(parent_link, f"{parent_link}_fixed", "fixed", parent.link, origin)
        place = self.bodies[name] = Place(parent_link, inside, parent.world @ pose, element.get("mocap") == "true")
        self._add_mass(item, parts, place, moving or moves, free=name in self.free)
        for child, own, its_class in parts:
            if child.tag == "site":
                self._add_site(child, place, own, its_class)
            elif child.tag == "body":
                self._add_body(child, place, own, its_class, moving=moving or moves)

    def _list_joints(
        self, element: Element, frame: Transform, child_class: str, body: str
    ) -> list[tuple[Item, str, np.ndarray, np.ndarray]]:
        """Return a joint as hinges and slides: item, kind (empty for a fixed one), anchor and axis in the body's frame."""
        item = self.file.item(element, child_class)
        kind = "free" if element.tag == "freejoint" else item.get("type", "hinge")
        name = item.get("name") or f"{body}_joint{len(self.positions) + 1}"
        if kind == "free":
            self.positions.append((name, 7))
            self.free.append(body)
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
        return [(named, "" if name in self._locked else kind, anchor, axis / np.linalg.norm(axis))]

    def _read_reference(self, joint: Item, kind: str) -> float:
        value = joint.number("ref", 0.0)
        return value if (kind or joint.get("type", "hinge")) == "slide" else joint.angle(value)

    def _add_link(self, link: str, joint: str, kind: str, parent: str, origin: Transform) -> None:
        self._links[link] = SubElement(self.root, "link", name=link)
        types = {"fixed": "fixed", "hinge": "revolute", "slide": "prismatic"}
        element = SubElement(self.root, "joint", name=joint, type=types[kind])
        SubElement(element, "parent", link=parent)
        SubElement(element, "child", link=link)
        SubElement(
            element, "origin", xyz=format_numbers(origin.origin), rpy=format_numbers(compute_rpy(origin.rotation))
        )

    def _describe_joint(self, item: Item, kind: str, axis: np.ndarray, reference: float) -> None:
        name, element = item.get("name"), self.root[-1]
        if name in self.joints:
            raise InputError("robot_structure", f"{self.file.where}: two joints are called '{name}'")
        SubElement(element, "axis", xyz=format_numbers(axis))
        bounds = item.limits("range", "limited")
        if bounds is not None and kind == "hinge":
            bounds = np.array([item.angle(x) for x in bounds])
        if bounds is None and kind == "hinge":
            element.set("type", "continuous")
        lower, upper = (-_ENDLESS, _ENDLESS) if bounds is None else bounds
        friction = {"damping": item.numbers("damping", "0")[0], "friction": item.number("frictionloss", 0.0)}
        SubElement(element, "dynamics", {key: format_numbers(value) for key, value in friction.items()})
        force = item.limits("actuatorfrcrange", "actuatorfrclimited")
        effort = 0.0 if force is None else float(np.abs(force).max())
        limit = {"effort": effort, "velocity": 0.0, "lower": lower, "upper": upper}
        SubElement(element, "limit", {key: format_numbers(value) for key, value in limit.items()})
        self.joints[name] = MjcfJoint(item, element, item.number("armature", 0.0), reference, effort)
        if any(item.numbers("stiffness", "0")):
            self.left_out.setdefault("springs of joints", []).append(name)

    def _measure_mesh(self, name: str) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Return volume, centre and inertia of a mesh at unit density; None if the file's way of summing it is another."""
        mesh = self.file.meshes.get(name)
        if mesh is None or mesh.inertia not in FORMS:
            return None
        triangles = read_triangles(self.file.folder / mesh.path) * mesh.scale
        return measure_mesh(triangles if np.prod(mesh.scale) > 0 else triangles[:, ::-1], mesh.inertia)

    def _add_mass(
        self, item: Item, parts: list[tuple[Element, Transform, str]], place: Place, moving: bool, *, free: bool
    ) -> None:
        link, compiler = self._links[place.link], self.file.compiler
        shapes = [
            read_shape(self.file.item(child, its_class), own) for child, own, its_class in parts if child.tag == "geom"
        ]
        moving = moving or (free and all(shape.kind != "mesh" for shape in shapes))
        mode, where = compiler.get("inertiafromgeom", "auto"), item.where
        given = next((child for child, *_ in parts if child.tag == "inertial"), None)
        body = BodyMass(0.0, np.zeros(3), np.zeros((3, 3)))
        if given is not None and mode != "true":
            body = read_inertial(Item("inertial", dict(given.attrib), f"{where}: <inertial>", compiler))
        elif mode != "false" and moving:
            settings = Item("compiler", compiler, f"{self.file.where}: <compiler>", compiler)
            low, high = settings.numbers("inertiagrouprange", "0 5", 2)
            body = sum_shapes(shapes, (low, high), where, self._measure_mesh)
        if moving:
            settings = Item("compiler", compiler, f"{self.file.where}: <compiler>", compiler)
            least = settings.number("boundmass", 0.0), settings.number("boundinertia", 0.0)
            body = bound_mass(body, *least, compiler.get("balanceinertia", "false") == "true")
        if body.mass:
            inertia = place.inside.rotation @ body.inertia @ place.inside.rotation.T
            inertial = SubElement(link, "inertial")
            SubElement(inertial, "origin", xyz=format_numbers(place.inside.place(body.centre)), rpy="0 0 0")
            SubElement(inertial, "mass", value=format_numbers(body.mass))
            entries = {f"i{'xyz'[i]}{'xyz'[j]}": format_numbers(inertia[i, j]) for i in range(3) for j in range(i, 3)}
            SubElement(inertial, "inertia", entries)
        for shape in shapes:
            self._draw(link, shape, place.inside)
        if item.number("gravcomp", 0.0):
            self.left_out.setdefault("gravity compensation of bodies", []).append(item.get("name"))

    def _draw(self, link: Element, shape: Geom, inside: Transform) -> None:
        """Add a shape to a link's visuals; URDF has no capsule, of which only the tube is drawn, and no ellipsoid."""
        group, pose = int(shape.item.number("group", 0.0)), inside @ shape.pose
        mesh = self.file.meshes.get(shape.item.get("mesh")) if shape.kind == "mesh" else None
        if group > _SHOWN_GROUPS or (mesh is None and shape.kind not in ("box", "sphere", "cylinder", "capsule")):
            return
        visual = SubElement(link, "visual")
        SubElement(visual, "origin", xyz=format_numbers(pose.origin), rpy=format_numbers(compute_rpy(pose.rotation)))
        geometry, (x, _, z) = SubElement(visual, "geometry"), shape.size
        if mesh is not None:
            SubElement(geometry, "mesh", filename=mesh.path, scale=format_numbers(mesh.scale))
        elif shape.kind == "box":
            SubElement(geometry, "box", size=format_numbers(2 * shape.size))
        elif shape.kind == "sphere":
            SubElement(geometry, "sphere", radius=format_numbers(x))
        else:
            SubElement(geometry, "cylinder", radius=format_numbers(x), length=format_numbers(2 * z))
        colour = self.file.find_colour(shape.item)
        if colour is not None:
            material = SubElement(visual, "material", name=format_numbers(colour))
            SubElement(material, "color", rgba=format_numbers(colour))

    def _add_site(self, element: Element, place: Place, frame: Transform, child_class: str) -> None:
        name = element.get("name")
        if not name:
            return
        pose = frame @ self.file.item(element, child_class).pose()
        link = self._own(name if name not in self.bodies else f"{name}_site")
        self._add_link(link, f"{link}_fixed", "fixed", place.link, place.inside @ pose)
        self.sites[name] = Place(place.link, place.inside @ pose, place.world @ pose)

    def _own(self, name: str) -> str:
        """Return a unique name of a link, which no joint and no other link has."""
        while name in self._names:
            name = f"{name}_link"
        self._names.add(name)
        return name

    def _find_locked(self) -> None:
        """Find the joints that an equation fixes."""
        held = {
            item.get("joint1"): self.read_polynomial(item)[0]
            for item in self.list_equations("joint")
            if not item.get("joint2")
        }
        for section in self.file.root.findall("worldbody"):
            for joint, child_class in _iterate_joints(section, ""):
                if joint.get("name") in held:
                    item = self.file.item(joint, child_class)
                    self._locked[joint.get("name", "")] = held[joint.get("name", "")] + self._read_reference(item, "")


def _iterate_joints(element: Element, child_class: str) -> Iterator[tuple[Element, str]]:
    for child in element:
        if child.tag == "joint":
            yield child, child_class
        else:
            yield from _iterate_joints(child, child.get("childclass", child_class))


def _move(kind: str, anchor: np.ndarray, axis: np.ndarray, position: float) -> Transform:
    """Return a joint's motion of its body (hinge or slide) from its reference, in the body's frame."""
    if kind == "slide":
        return Transform(np.eye(3), position * axis)
    turn = turn_about(axis, position)
    return Transform(turn, anchor - turn @ anchor)


def format_numbers(values: float | Iterable[float]) -> str:
    """Return numbers as text with all digits."""
    return " ".join(repr(float(x)) for x in np.ravel(np.asarray(values, float)))
