"""Simple solids, the distance of points from them, and the solids of a robot's links in its file.

A distance is signed: negative inside, exact outside. `coal_shape` returns the same solid for coal, the collision library that
comes with Pinocchio. Every solid is defined in its own frame, centred at the origin; the axis of cylinders and capsules is z, a
half-space is the part below z = 0. Links are boxes, cylinders and spheres of `<collision>`, else of `<visual>`; rods are
capsules between their joints with the thickness drawn in the file. Meshes are left out and named.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from xml.etree.ElementTree import Element

import coal
import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.robot import Robot


@dataclass(frozen=True)
class Box:
    """A box; `size` (3,) are its whole edges [m]."""

    size: tuple[float, float, float]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        x, y, z = (np.abs(points[..., k]) - self.size[k] / 2 for k in range(3))
        deepest = np.maximum(np.maximum(x, y), z)
        outside = np.sqrt(np.maximum(x, 0.0) ** 2 + np.maximum(y, 0.0) ** 2 + np.maximum(z, 0.0) ** 2)
        return outside + np.minimum(deepest, 0.0)

    @property
    def half_size(self) -> np.ndarray:
        """Half of its extents along its own axes (3,) [m]."""
        return np.array(self.size) / 2

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Box(*self.size)

    def cover(self, finest: float) -> tuple[np.ndarray, float]:
        """Return centres (m, 3) and the radius of spheres that together hold it."""
        size = np.asarray(self.size)
        n = np.clip(np.ceil(size / max(finest, size.max() / 12)), 1, 12).astype(int)
        axes = [(np.arange(k) + 0.5) / k * s - s / 2 for k, s in zip(n, size, strict=True)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return centres, float(np.linalg.norm(size / n)) / 2


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z [m]."""

    radius: float
    height: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        around = np.hypot(points[..., 0], points[..., 1]) - self.radius
        along = np.abs(points[..., 2]) - self.height / 2
        return np.hypot(np.maximum(around, 0.0), np.maximum(along, 0.0)) + np.minimum(np.maximum(around, along), 0.0)

    @property
    def half_size(self) -> np.ndarray:
        """Half of its extents along its own axes (3,) [m]."""
        return np.array([self.radius, self.radius, self.height / 2])

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Cylinder(self.radius, self.height)

    def cover(self, finest: float) -> tuple[np.ndarray, float]:
        """Return centres (m, 3) and the radius of spheres that together hold it."""
        return Box((2 * self.radius, 2 * self.radius, self.height)).cover(finest)


@dataclass(frozen=True)
class Sphere:
    """A sphere [m]."""

    radius: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        return np.sqrt(np.einsum("...i,...i->...", points, points)) - self.radius

    @property
    def half_size(self) -> np.ndarray:
        """Half of its extents along its own axes (3,) [m]."""
        return np.full(3, self.radius)

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Sphere(self.radius)

    def cover(self, finest: float) -> tuple[np.ndarray, float]:
        """Return centres (1, 3) and the radius of spheres that together hold it."""
        return np.zeros((1, 3)), self.radius


@dataclass(frozen=True)
class Capsule:
    """A rod with round ends: all points within `radius` of a segment of the z axis with `length` [m]."""

    radius: float
    length: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        z = points[..., 2] - np.clip(points[..., 2], -self.length / 2, self.length / 2)
        return np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + z**2) - self.radius

    @property
    def half_size(self) -> np.ndarray:
        """Half of its extents along its own axes (3,) [m]."""
        return np.array([self.radius, self.radius, self.length / 2 + self.radius])

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Capsule(self.radius, self.length)

    def cover(self, finest: float) -> tuple[np.ndarray, float]:
        """Return centres (m, 3) and the radius of spheres that together hold it."""
        n = int(np.clip(np.ceil(self.length / max(finest, 1e-9)), 1, 48))
        centres = np.zeros((n, 3))
        centres[:, 2] = ((np.arange(n) + 0.5) / n - 0.5) * self.length
        return centres, self.radius + self.length / n / 2


@dataclass(frozen=True)
class HalfSpace:
    """All points below z = 0 of its frame."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        return np.asarray(points[..., 2], float)

    @property
    def half_size(self) -> np.ndarray:
        """Half of its extents along its own axes (3,) [m]."""
        return np.full(3, np.inf)

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)


Solid = Box | Cylinder | Sphere | Capsule
Shape = Solid | HalfSpace


ROD_RADIUS = 0.015
"""Radius of a rod that the file does not draw [m]."""


@dataclass(frozen=True, eq=False)
class Body:
    """A solid on a link.

    Attributes:
        name: Link name without `_link`.
        joint: Pinocchio's index of the joint that carries it, 0 for the frame.
        shape: The solid; for a rod a capsule as long as the distance of its joints.
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
    """Return the radius [m] of a rod as drawn in the file; a numbered rod of one link takes the link's."""
    for wanted in (name, name.rpartition("_")[0]):
        for body in bodies:
            if body.name == wanted and isinstance(body.shape, Cylinder):
                return body.shape.radius
    return ROD_RADIUS


def build_rod_body(name: str, radius: float, length: float, index: int) -> Body:
    """Return a rod; its joint is -1, since it connects two points."""
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
