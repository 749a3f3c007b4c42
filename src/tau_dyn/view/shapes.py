"""What a robot file draws: boxes, cylinders and spheres that its joints carry, coloured by what they do.

The file's visual primitives are taken as they are, in its own colours where it has some; meshes are not read (a robot file should
not open files). A visual named `envelope` is the room that a part takes, for programs that know nothing better: here the part is
drawn through its joints instead, where it has three or more (`furniture.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from tau_dyn.robot import Robot
from tau_dyn.view.palette import ROLES, Rgb

ENVELOPE = "envelope"
_MIN = 1e-6  # m; a body smaller than this is not drawn


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid in the frame of the joint that carries it.

    Attributes:
        kind: `box`, `cylinder` (along z), `sphere` or `hull`.
        size: Side lengths (3,), radius and height (2,), radius (1,) [m]; for a hull its vertices (n, 3) [m].
        joint: Pinocchio's index of the joint; 0 for the world.
        rotation: In the joint's frame (3, 3).
        position: In the joint's frame (3,) [m].
        role: What it does: a key of `palette.ROLES`.
        colour: Its colour.
        faces: Of a hull (m, 3), counted outwards; else empty.
        envelope: Whether it stands for something better.
    """

    kind: str
    size: np.ndarray
    joint: int
    rotation: np.ndarray
    position: np.ndarray
    role: str = "passive"
    colour: Rgb = ROLES["passive"]
    faces: np.ndarray | None = None
    envelope: bool = False

    @property
    def local(self) -> pin.SE3:
        """Where it is in the joint's frame."""
        return pin.SE3(self.rotation, self.position)

    @property
    def half(self) -> np.ndarray:
        """Half the sides of the box around it (3,) [m]; of a hull nothing."""
        if self.kind == "box":
            return self.size / 2
        if self.kind == "cylinder":
            return np.array([self.size[0], self.size[0], self.size[1] / 2])
        return np.full(3, self.size[0]) if self.kind == "sphere" else np.zeros(3)

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Return its point nearest to a point (3,) of the joint's frame; a cylinder's lies on its axis."""
        half = self.half * (np.array([0.0, 0.0, 1.0]) if self.kind == "cylinder" else 1.0)
        return self.local.act(np.clip(self.local.actInv(point), -half, half))


def build_visual_shapes(robot: Robot) -> list[Shape]:
    """Return the file's primitives."""
    root = _without_meshes(robot.urdf)
    geometry = pin.buildGeomFromUrdfString(robot.model, _text(root), pin.GeometryType.VISUAL)
    rooms, role = _envelopes(root), list_body_roles(robot)
    found = []
    for item in geometry.geometryObjects.tolist():
        shape = _primitive(item)
        if shape is not None:
            own = ROLES[role[shape.joint]]
            colour = _rgb(item.meshColor) if item.overrideMaterial else own
            found.append(replace(shape, role=role[shape.joint], colour=colour, envelope=item.name in rooms))
    return found


def list_body_roles(robot: Robot) -> list[str]:
    """Return what each joint's body does (njoints,): read from the tree, not from names."""
    model, driven = robot.model, {robot.model.getJointId(j) for j in robot.actuated}
    ends = [model.frames[f].parentJoint for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    tool = None if robot.tool_frame is None or not robot.loops else model.frames[robot.tool_frame].parentJoint
    found = ["frame"] + ["passive"] * (model.njoints - 1)
    for joint in range(model.njoints - 1, 0, -1):
        carried = [found[c] for c in range(joint + 1, model.njoints) if model.parents[c] == joint and c not in driven]
        if joint in driven:
            found[joint] = "driven"
        elif joint == tool or ends.count(joint) > 1 or "plate" in carried:
            found[joint] = "plate"
        elif joint in ends or "rod" in carried or _telescopes(robot, joint, driven):
            found[joint] = "rod"
    return found


def _telescopes(robot: Robot, joint: int, driven: set[int]) -> bool:
    ends = {robot.model.frames[f].parentJoint for loop in robot.loops for f in (loop.frame_a, loop.frame_b)}
    return any(c in driven and c in ends and robot.model.parents[c] == joint for c in range(robot.model.njoints))


def _without_meshes(urdf: str) -> Element:
    """Return the file with each mesh as a box of no size, so that no file is opened."""
    from defusedxml.ElementTree import fromstring

    root = fromstring(urdf, forbid_dtd=True)
    for geometry in root.iter("geometry"):
        for mesh in geometry.findall("mesh"):
            geometry.remove(mesh)
            geometry.append(geometry.makeelement("box", {"size": "0 0 0"}))
    return root


def _text(root: Element) -> str:
    from defusedxml.ElementTree import tostring

    return tostring(root, encoding="unicode")


def _envelopes(root: Element) -> set[str]:
    """Return Pinocchio's names of the visuals named `envelope`."""
    links = {link.get("name", ""): link.findall("visual") for link in root.findall("link")}
    return {f"{n}_{k}" for n, all_ in links.items() for k, v in enumerate(all_) if v.get("name") == ENVELOPE}


def _primitive(item: Any) -> Shape | None:
    shape, kind = item.geometry, type(item.geometry).__name__
    if kind == "Box":
        name, size = "box", 2 * np.asarray(shape.halfSide, float)
    elif kind == "Cylinder":
        name, size = "cylinder", np.array([shape.radius, 2 * shape.halfLength])
    elif kind == "Sphere":
        name, size = "sphere", np.array([shape.radius])
    else:
        return None
    if np.max(size) < _MIN:
        return None
    place = item.placement
    return Shape(name, size, int(item.parentJoint), place.rotation.copy(), place.translation.copy())


def _rgb(rgba: np.ndarray) -> Rgb:
    r, g, b = (round(255 * float(np.clip(c, 0, 1))) for c in rgba[:3])
    return r, g, b
