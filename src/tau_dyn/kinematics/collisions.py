"""Which poses make a robot touch itself, its frame or obstacles, for many poses at once.

Spheres that cover one solid, against the exact distance of the other, settle most poses in arrays: all spheres clear is
clear, a centre within the other solid is a touch. Only what lies between goes to coal, one pose at a time. Solids that
touch at home (a cart on its guideway, what the file draws into each other, a rod and the solid in which its joint sits) are
left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from tau_dyn.kinematics.obstacles import Obstacle
from tau_dyn.kinematics.solids import Body, Capsule, Cylinder, HalfSpace, Shape, Sphere

_COVERS = (0.6, 0.15, 0.04)  # [m] sizes of covering spheres, coarse first: most poses are settled by few of them
_BATCH = 4000  # poses at a time, tens of MB


class PlacedSolid(NamedTuple):
    """A solid at many poses.

    Attributes:
        shape: The solid.
        rotation: Of its frame (N, 3, 3), or (1, 3, 3) where it stands.
        position: (N, 3) or (1, 3) [m].
        length: Of a capsule whose length varies (N,) [m], or None.
    """

    shape: Shape
    rotation: np.ndarray
    position: np.ndarray
    length: np.ndarray | None = None

    def take(self, index: np.ndarray) -> PlacedSolid:
        """Return the solid at some of the poses."""
        moves, turns = len(self.position) > 1, len(self.rotation) > 1
        return PlacedSolid(
            self.shape,
            self.rotation[index] if turns else self.rotation,
            self.position[index] if moves else self.position,
            None if self.length is None else self.length[index],
        )

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances (N, m) [m] of points (N, m, 3) in the world."""
        local = (points - self.position[:, None]) @ self.rotation
        if self.length is None or not isinstance(self.shape, Capsule):
            return self.shape.distance(local)
        half = self.length[:, None] / 2
        z = local[..., 2] - np.clip(local[..., 2], -half, half)
        return np.sqrt(local[..., 0] ** 2 + local[..., 1] ** 2 + z**2) - self.shape.radius

    def cover(self, size: float) -> tuple[np.ndarray, np.ndarray | float, float]:
        """Return spheres of about a size [m] that cover it: centres (N, m, 3), radius (number or (N, 1)), the centres' depth."""
        assert not isinstance(self.shape, HalfSpace)  # a half-space is no body
        local, radius = self.shape.cover(size)
        deep = self.shape.radius if isinstance(self.shape, Capsule | Sphere) else 0.0
        deep = -np.inf if isinstance(self.shape, Cylinder) else deep  # centres near its rim may lie outside
        if self.length is not None and isinstance(self.shape, Capsule):
            share = local / max(self.shape.length, 1e-9)
            places = share * self.length[:, None, None]
            half = self.length[:, None] / len(local) / 2
            return places @ np.swapaxes(self.rotation, 1, 2) + self.position[:, None], self.shape.radius + half, deep
        return local @ np.swapaxes(self.rotation, 1, 2) + self.position[:, None], radius, deep

    def for_coal(self, k: int):
        """Return shape and placement at pose `k` for coal."""
        turn = self.rotation[k if len(self.rotation) > 1 else 0]
        place = self.position[k if len(self.position) > 1 else 0]
        shape = self.shape.coal_shape
        if self.length is not None and isinstance(self.shape, Capsule):
            shape = coal.Capsule(self.shape.radius, float(self.length[k]))
        return shape, coal.Transform3s(np.ascontiguousarray(turn), np.ascontiguousarray(place))


def build_standing_solid(shape: Shape, placement: pin.SE3) -> PlacedSolid:
    """Return a solid that does not move."""
    return PlacedSolid(shape, placement.rotation[None].copy(), placement.translation[None].copy())


def move_solid(body: Body, rotation: np.ndarray, position: np.ndarray) -> PlacedSolid:
    """Return a link's solid from its joint's frames: rotations (N, 3, 3), origins (N, 3)."""
    at = body.placement
    return PlacedSolid(body.shape, rotation @ at.rotation, position + rotation @ at.translation)


def build_capsule(radius: float, length: float, start: np.ndarray, end: np.ndarray) -> PlacedSolid:
    """Return a rod of nominal `length` as a capsule between points (N, 3) [m]."""
    along = end - start
    size = np.linalg.norm(along, axis=1)
    z = along / np.maximum(size, 1e-9)[:, None]
    return PlacedSolid(Capsule(radius, max(length, 1e-6)), _frames(z), (start + end) / 2, size)


def _frames(z: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) whose third axis is `z` (N, 3)."""
    helper = np.where(np.abs(z[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], axis=2)


def find_collisions(a: PlacedSolid, b: PlacedSolid, margin: float = 0.0) -> np.ndarray:
    """Return at which poses (N,) two solids come closer than `margin` [m]; `a` is no half-space."""
    n = max(len(a.position), len(b.position), len(a.rotation), len(b.rotation))
    out = np.zeros(n, bool)
    for start in range(0, n, _BATCH):
        part = np.arange(start, min(start + _BATCH, n))
        out[part] = _touch(a.take(part), b.take(part), margin, len(part))
    return out


def _touch(a: PlacedSolid, b: PlacedSolid, margin: float, n: int) -> np.ndarray:
    hit, unsure = np.zeros(n, bool), np.arange(n)
    for size in _COVERS:
        here, there = a.take(unsure), b.take(unsure)
        centres, radius, deep = here.cover(size)
        gap = there.distance(centres)
        certain = (gap < margin + deep).any(axis=1)
        open_ = ~certain & (gap - radius <= margin).any(axis=1)
        certain, open_ = np.broadcast_to(certain, unsure.shape), np.broadcast_to(open_, unsure.shape)
        hit[unsure[certain]] = True
        unsure = unsure[open_]
        if not len(unsure):
            return hit
    for k in unsure:
        hit[k] = _near(a, b, int(k), margin)
    return hit


def _near(a: PlacedSolid, b: PlacedSolid, k: int, margin: float) -> bool:
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    request.security_margin = margin
    return bool(coal.collide(*a.for_coal(k), *b.for_coal(k), request, result))


def find_touched_obstacle(obstacle: Obstacle, solids: Sequence[PlacedSolid], n: int) -> np.ndarray:
    """Return at which poses (n,) any of a robot's solids comes too close to an obstacle."""
    wall, out = build_standing_solid(obstacle.shape, obstacle.placement), np.zeros(n, bool)
    for solid in solids:
        left = np.flatnonzero(~out)
        if len(left):
            out[left] = find_collisions(solid.take(left), wall, obstacle.margin)
    return out
