"""Mass, centre and inertia of MJCF bodies: as given in the file, or computed from their shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot.mjcf_file import Item, Transform, turn_z_to

_DENSITY = 1000.0  # [kg/m^3] MuJoCo's default, of water
_FLAT = ("plane", "hfield")
_NO_MASS = 1e-15  # [kg] below which MuJoCo leaves a shape out
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
"""Number of entries of `size` for each shape; one fewer if its ends are given."""


class BodyMass(NamedTuple):
    """Mass [kg], centre (3,) [m] in the body's frame, inertia (3, 3) about the centre in its axes [kg m^2]."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


class Geom(NamedTuple):
    """A geom: its element, kind, half sizes (3,) [m] and pose in the body's frame."""

    item: Item
    kind: str
    size: np.ndarray
    pose: Transform


def read_shape(item: Item, frame: Transform) -> Geom:
    """Return a geom that is given in a frame of its body; a capsule's or cylinder's `size` is radius, radius, half length.

    Raises:
        InputError: Its size lacks a number.
    """
    kind = item.get("type", "sphere")
    if item.get("mesh") and kind != "mesh":
        kind = "mesh"  # a primitive fitted to a mesh, whose size is given by the mesh file
    if kind not in _SIZES:
        return Geom(item, kind, np.zeros(3), frame @ item.pose())
    pose, n = item.pose(), _SIZES[kind]
    given = np.abs(item.numbers("size", "0 0 0"))
    if item.get("fromto") and kind != "sphere":
        ends = item.numbers("fromto", "", 6)
        along = ends[:3] - ends[3:]  # MuJoCo's direction of the shape's z axis
        length = float(np.linalg.norm(along))
        pose = Transform(turn_z_to(along / length) if length else np.eye(3), (ends[:3] + ends[3:]) / 2)
        given = np.array([*[given[0]] * (n - 1), length / 2])
    if len(given) < n:
        raise InputError("robot_structure", f"{item.where}: size='{item.get('size')}' has too few numbers for a {kind}")
    return Geom(item, kind, np.array([*[given[0]] * (3 - n), *given[:n]]), frame @ pose)


def read_inertial(item: Item) -> BodyMass:
    """Return the inertia of an `<inertial>` element.

    Raises:
        InputError: A number is missing or negative.
    """
    pose, mass = item.pose(), item.number("mass", 0.0)
    if "mass" not in item.values or mass < 0:
        raise InputError("robot_structure", f"{item.where}: mass='{item.get('mass')}' must be a number from zero up")
    if "fullinertia" in item.values:
        xx, yy, zz, xy, xz, yz = item.numbers("fullinertia", "", 6)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        inertia = np.diag(item.numbers("diaginertia", "0 0 0", 3))
    return BodyMass(mass, pose.origin, pose.rotation @ inertia @ pose.rotation.T)


Measure = Callable[[str], "tuple[float, np.ndarray, np.ndarray] | None"]
"""Returns a mesh's volume [m^3], centre (3,) [m] and inertia (3, 3) about it at unit density [m^5]; None without an answer."""


def sum_shapes(shapes: Iterable[Geom], groups: tuple[float, float], where: str, measure: Measure) -> BodyMass:
    """Return the inertia of a body's shapes whose group is in a range.

    Raises:
        InputError: A shape with mass, or a mesh file, cannot be measured.
    """
    parts = [part for shape in shapes if (part := _weigh(shape, groups, where, measure)) is not None]
    mass = sum(part.mass for part in parts)
    if not mass:
        return BodyMass(0.0, np.zeros(3), np.zeros((3, 3)))
    centre = sum((part.mass * part.centre for part in parts), np.zeros(3)) / mass
    return BodyMass(mass, centre, sum((_shift(part, centre) for part in parts), np.zeros((3, 3))))


def bound_mass(body: BodyMass, least_mass: float, least_inertia: float, balance: bool) -> BodyMass:
    """Return a body after the compiler's `boundmass`, `boundinertia` and `balanceinertia`."""
    moments, axes = np.linalg.eigh(body.inertia)
    if balance and moments[2] > moments[0] + moments[1]:
        moments = np.full(3, moments.mean())
    elif not least_inertia:
        return body._replace(mass=max(body.mass, least_mass))
    moments = np.maximum(moments, least_inertia)
    return BodyMass(max(body.mass, least_mass), body.centre, axes @ np.diag(moments) @ axes.T)


def _weigh(shape: Geom, groups: tuple[float, float], where: str, measure: Measure) -> BodyMass | None:
    item = shape.item
    given = item.number("mass", 0.0) if "mass" in item.values else None
    density = item.number("density", _DENSITY)
    massless = given == 0.0 if given is not None else density == 0.0
    if massless or shape.kind in _FLAT or not groups[0] <= item.number("group", 0.0) <= groups[1]:
        return None
    solid = item.get("shellinertia", "false") != "true"
    if (
        shape.kind == "mesh"
        and item.get("type") == "mesh"
        and solid
        and (found := measure(item.get("mesh"))) is not None
    ):
        volume, centre, inertia = found
        mass = density * volume if given is None else given
        if mass < _NO_MASS or not volume > 0:
            return None
        turn = shape.pose.rotation
        return BodyMass(mass, shape.pose.place(centre), turn @ (mass / volume * inertia) @ turn.T)
    if shape.kind not in _SIZES or not solid:
        what = f"mesh '{item.get('mesh')}'" if shape.kind == "mesh" else f"a geom of type {shape.kind} or a shell"
        raise InputError("unsupported", f"{where} takes its inertia from {what}; give it an <inertial>")
    volume, unit = _measure(shape.kind, shape.size)
    mass = density * volume if given is None else given
    if mass < _NO_MASS:
        return None
    turn = shape.pose.rotation
    return BodyMass(mass, shape.pose.origin, turn @ np.diag(mass * unit) @ turn.T)


def _measure(kind: str, size: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a solid's volume [m^3] and its moments about its axes per mass (3,) [m^2]."""
    x, y, z = size
    if kind == "box":
        return 8 * x * y * z, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 3
    if kind in ("sphere", "ellipsoid"):
        return 4 / 3 * np.pi * x * y * z, np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 5
    tube, ball = 2 * np.pi * x * x * z, 4 / 3 * np.pi * x**3 if kind == "capsule" else 0.0
    share = tube / (tube + ball) if tube + ball else 0.0
    across = share * (3 * x * x + 4 * z * z) / 12 + (1 - share) * (2 * x * x / 5 + z * z + 3 * z * x / 4)
    along = share * x * x / 2 + (1 - share) * 2 * x * x / 5
    return tube + ball, np.array([across, across, along])


def _shift(part: BodyMass, centre: np.ndarray) -> np.ndarray:
    d = part.centre - centre
    return part.inertia + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
