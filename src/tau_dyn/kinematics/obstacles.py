"""Obstacles and safety zones around a robot, and Cartesian limits of its tool, read from YAML.

limits: {x: [0.5, 2.5], z: [0.2, .inf]}          # of the tool [m]; an end may be left open
obstacles:
- name: table
  box: {centre: [1.0, -1.2, 0.4], size: [0.8, 0.6, 0.8], rpy: [0, 0, 0]}      # m, rad
  margin: 0.05                                 # [m] that must stay free around it; 0 if left out
- name: wall
  half_space: {point: [0, 2, 0], normal: [0, -1, 0]}      # the normal points into free space
- name: operator
  cylinder: {centre: [2, 0, 0], radius: 0.5, height: 4, axis: [0, 0, 1]}
  blocks: tool                                 # only the tool's point must stay out; default: robot, all of it
- name: lamp
  sphere: {centre: [1, 0, 2], radius: 0.1}

Collisions of a robot with itself, its frame or obstacles are found for many poses at once. One solid is covered by spheres, whose
centres are compared with the exact distance of the other solid. Most poses are decided in arrays: if all spheres are clear, the
pose is clear; if a centre is within the other solid, the solids touch. Only the undecided poses are passed to coal, one at a
time. Solids that touch at home (a cart on its guideway, solids that overlap in the file, a rod and the solid that holds its
joint) are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import coal
import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml
from tau_dyn.kinematics.solids import Body, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere

KINDS = ("box", "cylinder", "sphere", "half_space")
_KEYS = {
    "box": ({"centre", "size"}, {"rpy"}),
    "cylinder": ({"centre", "radius", "height"}, {"axis"}),
    "sphere": ({"centre", "radius"}, set()),
    "half_space": ({"point", "normal"}, set()),
}


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A solid that must not be touched.

    Attributes:
        name: Name given by the user.
        shape: The solid, in its own frame.
        placement: Frame of the solid in the world.
        margin: Distance to keep [m].
        blocks: `robot` (all of it) or `tool` (the tool's point alone: a safety zone).
    """

    name: str
    shape: Shape
    placement: pin.SE3
    margin: float = 0.0
    blocks: str = "robot"

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances of points (N, 3) in the world, negative inside [m]."""
        return self.shape.distance((points - self.placement.translation) @ self.placement.rotation)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Surroundings of a robot.

    Attributes:
        obstacles: Solids and zones.
        lower: Least coordinates of the tool (3,) [m], -inf without a limit.
        upper: Largest coordinates of the tool (3,) [m].
    """

    obstacles: tuple[Obstacle, ...] = ()
    lower: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    upper: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))


def read_surroundings(path: str | Path) -> Surroundings:
    """Read obstacles, zones and limits from a YAML file.

    Raises:
        InputError: The file cannot be read, or its content is wrong; the message names the obstacle, its key and the remedy.
    """
    return build_surroundings(read_yaml(path), str(path))


def build_surroundings(content: Any, where: str) -> Surroundings:
    """Return surroundings from the content of a YAML file; `where` is the start of error messages."""
    reader = _Reader(where)
    if not isinstance(content, Mapping) or not content:
        reader.fault("the file needs a list 'obstacles', or 'limits'")
    reader.keys(content, set(), {"obstacles", "limits"})
    lower, upper = reader.limits(content.get("limits") or {})
    listed = content.get("obstacles") or []
    if not isinstance(listed, list):
        reader.fault("'obstacles' must be a list, each with a name and one of " + ", ".join(KINDS))
    obstacles = [_Reader(f"{where}: obstacle {k + 1}").obstacle(item) for k, item in enumerate(listed)]
    names = [o.name for o in obstacles]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        reader.fault(f"two obstacles are called '{twice}'; give each its own name")
    return Surroundings(tuple(obstacles), lower, upper)


class _Reader:
    """Converts the content of YAML into solids; every error names the place."""

    def __init__(self, where: str) -> None:
        self.where = where

    def fault(self, text: str) -> NoReturn:
        raise InputError("file_format", f"{self.where}: {text}")

    def keys(self, given: Mapping[Any, Any], needed: set[str], optional: set[str]) -> None:
        unknown = [k for k in given if k not in needed | optional]
        if unknown:
            self.fault(f"'{unknown[0]}' is not known here; there are {', '.join(sorted(needed | optional))}")
        missing = min(needed - set(given), default=None)
        if missing is not None:
            self.fault(f"'{missing}' is missing")

    def numbers(self, given: Mapping[Any, Any], key: str, default: tuple[float, ...] | None = None) -> np.ndarray:
        value: Any = given.get(key, default)
        if not isinstance(value, list | tuple) or len(value) != 3 or not all(_is_number(v) for v in value):
            self.fault(f"{key} must hold three finite numbers, not {value}")
        return np.array(value, float)

    def positive(self, given: Mapping[Any, Any], key: str) -> float:
        value: Any = given.get(key)
        if not _is_number(value) or not value > 0:
            self.fault(f"{key} must be a number above zero, not {value}")
        return float(value)

    def direction(self, given: Mapping[Any, Any], key: str, default: tuple[float, ...] | None = None) -> np.ndarray:
        value = self.numbers(given, key, default)
        size = float(np.linalg.norm(value))
        if size < 1e-9:
            self.fault(f"{key} must have a direction, not {value.tolist()}")
        return value / size

    def limits(self, given: Any) -> tuple[np.ndarray, np.ndarray]:
        if not isinstance(given, Mapping):
            self.fault("'limits' must name axes, such as {x: [0.5, 2.5]}")
        self.keys(given, set(), {"x", "y", "z"})
        lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
        for axis, pair in given.items():
            if not isinstance(pair, list) or len(pair) != 2 or not all(_is_number(v, endless=True) for v in pair):
                self.fault(f"limits of {axis} must be two numbers, low and high, not {pair}")
            if not pair[0] < pair[1]:
                self.fault(f"limits of {axis} are inverted: {pair[0]} is not below {pair[1]}")
            lower["xyz".index(axis)], upper["xyz".index(axis)] = pair
        return lower, upper

    def obstacle(self, given: Any) -> Obstacle:
        if not isinstance(given, Mapping):
            self.fault(f"must have a name and one of {', '.join(KINDS)}")
        name = given.get("name")
        if not isinstance(name, str) or not name.strip():
            self.fault("needs a name")
        self.where = f"{self.where} ('{name}')"
        kinds = [k for k in KINDS if k in given]
        if len(kinds) != 1 or not isinstance(given[kinds[0]], Mapping):
            self.fault(f"needs exactly one of {', '.join(KINDS)}, with its numbers in braces")
        self.keys(given, {"name", kinds[0]}, {"margin", "blocks"})
        margin: Any = given.get("margin", 0.0)
        if not _is_number(margin) or margin < 0:
            self.fault(f"margin must be a number from zero up, not {margin}")
        blocks = given.get("blocks", "robot")
        if blocks not in ("robot", "tool"):
            self.fault(f"blocks is robot or tool, not {blocks}")
        shape, placement = self.solid(kinds[0], given[kinds[0]])
        return Obstacle(name.strip(), shape, placement, float(margin), blocks)

    def solid(self, kind: str, given: Mapping[Any, Any]) -> tuple[Shape, pin.SE3]:
        self.keys(given, *_KEYS[kind])
        if kind == "half_space":
            normal = self.direction(given, "normal")
            return HalfSpace(), pin.SE3(_turn_z_to(normal), self.numbers(given, "point"))
        centre = self.numbers(given, "centre")
        if kind == "sphere":
            return Sphere(self.positive(given, "radius")), pin.SE3(np.eye(3), centre)
        if kind == "cylinder":
            axis = self.direction(given, "axis", (0.0, 0.0, 1.0))
            return Cylinder(self.positive(given, "radius"), self.positive(given, "height")), pin.SE3(
                _turn_z_to(axis), centre
            )
        size = self.numbers(given, "size")
        if not (size > 0).all():
            self.fault(f"size must hold three numbers above zero, not {size.tolist()}")
        rpy = self.numbers(given, "rpy", (0.0, 0.0, 0.0))
        return Box((float(size[0]), float(size[1]), float(size[2]))), pin.SE3(pin.rpy.rpyToMatrix(rpy), centre)


def _is_number(value: Any, *, endless: bool = False) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e9 or (endless and (abs(value) < 1e300 or abs(value) == float("inf")))


def _turn_z_to(direction: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that turns z to a unit vector."""
    return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).matrix()


def add_limits(around: Surroundings, texts: Sequence[str]) -> Surroundings:
    """Return surroundings with further limits of the tool, each such as `x=0.5:2.5`; an end may be left empty.

    Raises:
        InputError: A limit has another form, is inverted, or is not a number.
    """
    lower, upper = around.lower.copy(), around.upper.copy()
    for text in texts:
        axis, equals, pair = text.partition("=")
        low, colon, high = pair.partition(":")
        try:
            ends = float(low) if low.strip() else -np.inf, float(high) if high.strip() else np.inf
        except ValueError:
            ends = np.nan, np.nan
        if axis not in ("x", "y", "z") or not equals or not colon or np.isnan(ends).any():
            raise InputError(
                "invalid_value", f"a limit of the tool is an axis and two places, such as x=0.5:2.5, not '{text}'"
            )
        if not ends[0] < ends[1]:
            raise InputError("invalid_value", f"the limits '{text}' are inverted: {ends[0]:g} is not below {ends[1]:g}")
        k = "xyz".index(axis)
        lower[k], upper[k] = max(lower[k], ends[0]), min(upper[k], ends[1])
    return Surroundings(around.obstacles, lower, upper)


_COVERS = (0.6, 0.15, 0.04)  # [m] sizes of covering spheres, coarse first: most poses are settled by few of them
_BATCH = 4000  # poses at a time, tens of MB


class PlacedSolid(NamedTuple):
    """A solid at many poses.

    Attributes:
        shape: The solid.
        rotation: Rotation of its frame (N, 3, 3), or (1, 3, 3) if it does not move.
        position: Origin of its frame (N, 3) or (1, 3) [m].
        length: Length of a capsule whose length varies (N,) [m], or None.
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
        assert not isinstance(self.shape, HalfSpace)  # a half-space is not bounded
        local, radius = self.shape.cover(size)
        deep = self.shape.radius if isinstance(self.shape, Capsule | Sphere) else 0.0
        deep = -np.inf if isinstance(self.shape, Cylinder) else deep  # centres near its rim may be outside
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
