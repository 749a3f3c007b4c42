"""Simple solids and how far points are from them: boxes, cylinders, spheres, capsules, half-spaces.

A distance is signed: negative inside, exact outside. `coal_shape` hands the same solid to coal, the collision library that
comes with Pinocchio. Every solid stands in its own frame, centred at the origin; cylinders and capsules lie along z, a
half-space is what lies below z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import coal
import numpy as np


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

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Sphere(self.radius)

    def cover(self, finest: float) -> tuple[np.ndarray, float]:
        """Return centres (1, 3) and the radius of spheres that together hold it."""
        return np.zeros((1, 3)), self.radius


@dataclass(frozen=True)
class Capsule:
    """A rod with round ends: all points within `radius` of a stretch of z as long as `length` [m]."""

    radius: float
    length: float

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        z = points[..., 2] - np.clip(points[..., 2], -self.length / 2, self.length / 2)
        return np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + z**2) - self.radius

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
    """All that lies below z = 0 of its frame."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (..., 3) in its frame [m]."""
        return np.asarray(points[..., 2], float)

    @cached_property
    def coal_shape(self):
        """The solid for coal."""
        return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)


Solid = Box | Cylinder | Sphere | Capsule
Shape = Solid | HalfSpace
