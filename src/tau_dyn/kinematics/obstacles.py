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
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml
from tau_dyn.kinematics.solids import Box, Cylinder, HalfSpace, Shape, Sphere

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
        name: As the user calls it.
        shape: The solid, in its own frame.
        placement: Its frame in the world.
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
    """What stands around a robot.

    Attributes:
        obstacles: Solids and zones.
        lower: Least coordinates of the tool (3,) [m], -inf for none.
        upper: Largest coordinates of the tool (3,) [m].
    """

    obstacles: tuple[Obstacle, ...] = ()
    lower: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    upper: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))


def read_surroundings(path: str | Path) -> Surroundings:
    """Read obstacles, zones and limits from a YAML file.

    Raises:
        InputError: The file cannot be read, or the message names the obstacle, its key and what would be right.
    """
    return build_surroundings(read_yaml(path), str(path))


def build_surroundings(content: Any, where: str) -> Surroundings:
    """Return surroundings from what a YAML file holds; `where` opens the messages."""
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
    """Turns what YAML holds into solids; every fault names the place."""

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
        InputError: A limit is written otherwise, inverted, or not a number.
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
