"""What a robot looks like, as boxes, cylinders and spheres that its joints carry.

The robot file's visual primitives are taken as they are. A link that has none is drawn as sticks from its own joint to those it
carries, its loops' ends and the tool, so that any tree is seen; meshes are not read (a robot file should not open files).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from tau_dyn.robot import Robot

STICK = 0.012
"""Radius of a stick, as a share of the robot's size."""
_MIN = 1e-6


@dataclass(frozen=True, eq=False)
class Shape:
    """A primitive in the frame of the joint that carries it.

    Attributes:
        kind: `box`, `cylinder` (along z) or `sphere`.
        size: Side lengths (3,), radius and height (2,), or radius (1,) [m].
        joint: Pinocchio's index of the joint; 0 for the world.
        rotation: In the joint's frame (3, 3).
        position: In the joint's frame (3,) [m].
    """

    kind: str
    size: np.ndarray
    joint: int
    rotation: np.ndarray
    position: np.ndarray


def shapes_of(robot: Robot) -> tuple[Shape, ...]:
    """Return a robot's shapes."""
    geometry = pin.buildGeomFromUrdfString(robot.model, _without_meshes(robot.urdf), pin.GeometryType.VISUAL)
    drawn = [shape for item in geometry.geometryObjects.tolist() if (shape := _primitive(item)) is not None]
    bare = set(range(1, robot.model.njoints)) - {shape.joint for shape in drawn}
    return (*drawn, *_sticks(robot, bare))


def _without_meshes(urdf: str) -> str:
    """Return the text with each mesh as a box of no size, so that no file is opened."""
    from defusedxml.ElementTree import fromstring, tostring

    root = fromstring(urdf, forbid_dtd=True)
    for geometry in root.iter("geometry"):
        for mesh in geometry.findall("mesh"):
            geometry.remove(mesh)
            geometry.append(geometry.makeelement("box", {"size": "0 0 0"}))
    return tostring(root, encoding="unicode")


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


def _sticks(robot: Robot, joints: set[int]) -> list[Shape]:
    """Return sticks from these joints to what they carry."""
    model = robot.model
    ends = [f for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    ends += [] if robot.tool_frame is None else [robot.tool_frame]
    reaches = {
        j: [model.jointPlacements[c].translation for c in range(1, model.njoints) if model.parents[c] == j]
        for j in joints
    }
    for frame in (model.frames[k] for k in ends):
        if frame.parentJoint in reaches:
            reaches[frame.parentJoint].append(frame.placement.translation)
    lengths = [float(np.linalg.norm(p)) for points in reaches.values() for p in points]
    radius = STICK * max(
        [*lengths, *(float(np.linalg.norm(p.translation)) for p in model.jointPlacements.tolist()), 0.05]
    )
    return [
        _stick(j, np.asarray(p), radius) for j, points in reaches.items() for p in points if np.linalg.norm(p) > radius
    ]


def _stick(joint: int, end: np.ndarray, radius: float) -> Shape:
    length = float(np.linalg.norm(end))
    along = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end / length).toRotationMatrix()
    return Shape("cylinder", np.array([radius, length]), joint, along, end / 2)
