"""The solids of a robot's links, read from its file: boxes, cylinders and spheres of `<collision>`, else of `<visual>`.

Rods are capsules between their joints, as thick as the file draws them. Meshes are left out and named.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.kinematics.shapes import Box, Capsule, Cylinder, Solid, Sphere
from tau_dyn.robot import Robot

ROD_RADIUS = 0.015
"""Radius of a rod that the file does not draw [m]."""


@dataclass(frozen=True, eq=False)
class Body:
    """A solid on a link.

    Attributes:
        name: Link name without `_link`.
        joint: Pinocchio's index of the joint that carries it, 0 for the frame.
        shape: The solid; of a rod a capsule that is as long as its joints lie apart.
        placement: The solid's frame in the joint's.
        rod: Index among the rods, -1 for other links.
    """

    name: str
    joint: int
    shape: Solid
    placement: pin.SE3
    rod: int = -1


def read_bodies(robot: Robot) -> tuple[list[Body], list[str]]:
    """Return the solids of a robot's links, and the names of links that are drawn by meshes alone."""
    found: list[Body] = []
    meshes: list[str] = []
    for link in fromstring(robot.urdf, forbid_dtd=True).findall("link"):
        name = link.get("name", "")
        if not robot.model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = robot.model.frames[robot.model.getFrameId(name, pin.FrameType.BODY)]
        pieces = link.findall("collision") or link.findall("visual")
        solids = [_solid(piece) for piece in pieces]
        if pieces and not any(shape is not None for shape, _ in solids):
            meshes.append(name)
        for shape, placement in solids:
            if shape is not None:
                found.append(Body(name.removesuffix("_link"), frame.parentJoint, shape, frame.placement * placement))
    return found, meshes


def measure_rod_radius(bodies: list[Body], name: str) -> float:
    """Return the radius [m] in which the file draws a rod; a numbered rod of one link takes the link's."""
    for wanted in (name, name.rpartition("_")[0]):
        for body in bodies:
            if body.name == wanted and isinstance(body.shape, Cylinder):
                return body.shape.radius
    return ROD_RADIUS


def build_rod_body(name: str, radius: float, length: float, index: int) -> Body:
    """Return a rod; its joint is -1, since it lies between two points."""
    return Body(name, -1, Capsule(radius, length), pin.SE3.Identity(), index)


def _solid(piece: Element) -> tuple[Solid | None, pin.SE3]:
    geometry, origin = piece.find("geometry"), piece.find("origin")
    placement = pin.SE3.Identity()
    if origin is not None:
        rpy, xyz = _numbers(origin.get("rpy", "0 0 0")), _numbers(origin.get("xyz", "0 0 0"))
        placement = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
    shape: Solid | None = None
    for item in geometry if geometry is not None else ():
        if item.tag == "box":
            x, y, z = _numbers(item.get("size", "0 0 0"))
            shape = Box((float(x), float(y), float(z))) if min(x, y, z) > 0 else None
        elif item.tag == "cylinder":
            radius, length = float(item.get("radius", 0)), float(item.get("length", 0))
            shape = Cylinder(radius, length) if min(radius, length) > 0 else None
        elif item.tag == "sphere":
            radius = float(item.get("radius", 0))
            shape = Sphere(radius) if radius > 0 else None
    return shape, placement


def _numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])
