"""A plate on legs as points and distances: `|A_k(q) - B_k(X)| = L_k` (thesis (4.4), (4.14); Merlet 2006, ch. 2).

Actuated chains carry points A, the plate at pose X carries points B, rods hold their distance. Public arrays have samples
first; the arrays of the solvers (`frames.py`, `rod_dimensions.py`) have samples last.

Rods lean in their ball joints, on the cart and on the plate, away from an axis: the direction, in the frame of the link that
holds the joint, of a rod in the middle of the joint's range, given from cart to plate. It is the rod's direction at home, or
given in the file by

    <tau_dyn:ball_joint rod="rod1" side="cart" axis="1 0 0" angle="0.7"/>

with side cart or plate and the largest angle in rad; axis or angle may be left out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, LoopClosureError, UnknownName
from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.poses import Poses, require_positions, turn_rotations
from tau_dyn.mechanism.rod_dimensions import RodDimensions
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

_CLOSED = 1e-12  # relative to the rods
_MAX_ITERATIONS = 30  # Newton steps from the file's pose
_STEP = 0.2  # of the rods' length or rad


class Ride(NamedTuple):
    """A tool that is fixed to the first leg's rod and turns with it about the rod's hinge; the plate is the point at the tool.

    Attributes:
        start: Vector from the hinge's axis to the tool at home, in the frame of the link that carries the hinge (3,) [m].
        rotation: The tool's rotation at home in that frame (3, 3).
    """

    start: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True, eq=False)
class Legs:
    """A parallel robot as points and distances.

    Attributes:
        robot: The robot.
        names: Rods, by their links' names without `_link`.
        lengths: (n,) [m]; of a rod with an actuated slide in it, at the slide's zero.
        on_plate: Points B in the plate's frame (n, 3) [m].
        plate: Plate link.
        translates: Whether the plate keeps `rotation` (simplified arms).
        rotation: Rotation (3, 3) of the plate at home with the file's geometry.
        tool: Tool frame in the plate's.
        geometry: All geometric parameters.
        nominal_home: Pose of the plate at home with the file's geometry (1 sample).
        numbers: The same geometry as arrays.
        ride: How the tool turns where the plate is one point, else None.
    """

    robot: Robot
    names: tuple[str, ...]
    lengths: np.ndarray
    on_plate: np.ndarray
    plate: str
    translates: bool
    rotation: np.ndarray
    tool: pin.SE3
    geometry: Parameters
    nominal_home: Poses
    numbers: RodDimensions
    ride: Ride | None = None

    @cached_property
    def home(self) -> Poses:
        """Pose of the plate at home (1 sample), with this geometry.

        Raises:
            LoopClosureError: With this geometry the rods cannot be closed at home.
        """
        return self._closed_at_home()

    @property
    def n(self) -> int:
        """Number of rods."""
        return len(self.names)

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return self.robot.na

    def base_points(self, q: np.ndarray) -> np.ndarray:
        """Return the points `A(q)` (N, n, 3) [m] at `q` (N, na)."""
        q = require_positions(self.robot, q)
        return frames.compute_points(self.numbers.joints, self.numbers.carried, q.T).transpose(2, 0, 1)

    def base_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return `dA/dq` (N, n, 3, na)."""
        q = require_positions(self.robot, q).T
        joints, carried = self.numbers.joints, self.numbers.carried
        at, places = frames.compute_joint_frames(joints, q), frames.compute_points(joints, carried, q)
        out = np.zeros((q.shape[1], self.n, 3, self.na))
        for (k, actuator), column in frames.compute_velocities(joints, carried, at, places).items():
            out[:, k, :, actuator] = np.broadcast_to(column, (3, q.shape[1])).T
        return out

    def leg_lengths(self, q: np.ndarray) -> np.ndarray:
        """Return the rods' lengths (N, n) [m], longer or shorter where a rod has an actuated slide."""
        q = require_positions(self.robot, q).T
        return np.array(np.broadcast_to(rod_dimensions.compute_leg_lengths(self.numbers, q), (self.n, q.shape[1])).T)

    def leg_rates(self, q: np.ndarray) -> np.ndarray:
        """Return `dL/dq` (N, n, na)."""
        q = require_positions(self.robot, q).T
        out = np.zeros((q.shape[1], self.n, self.na))
        rates = rod_dimensions.compute_leg_rates(self.numbers, q)
        for k in np.flatnonzero(self.numbers.slides >= 0):
            out[:, k, self.numbers.slides[k]] = rates[k]
        return out

    def plate_points(self, plate: Poses) -> np.ndarray:
        """Return the points `B(X)` (N, n, 3) [m] at poses of the plate."""
        return plate.position[:, None] + self.on_plate @ np.swapaxes(plate.rotation, 1, 2)

    def plate_poses(self, tool: Poses) -> Poses:
        """Return the plate's poses from the tool's."""
        return tool.after(self.tool.inverse())

    def tool_poses(self, plate: Poses) -> Poses:
        """Return the tool's poses from the plate's."""
        return plate.after(self.tool)

    def ridden(self, q: np.ndarray, tool: Poses) -> Poses:
        """Return the tool's poses (N) with its rotation at `q` (N, na) if it turns with a rod."""
        if self.ride is None:
            return tool
        carried, start = self.numbers.carried, self.ride.start
        ends = carried.local[:2]
        axis, foot = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]), ends.mean(axis=0)
        at = frames.WORLD
        if carried.carrier[0] >= 0:
            at = frames.compute_joint_frames(self.numbers.joints, q.T)[carried.carrier[0]]
        rotation = np.moveaxis(np.broadcast_to(at.rotation, (3, 3, len(q))), 2, 0)
        arm = np.einsum("nji,nj->ni", rotation, tool.position - at.origin.T) - foot
        angle = np.arctan2(np.cross(start, arm) @ axis, arm @ start - (arm @ axis) * (start @ axis))
        return Poses(tool.position, rotation @ turn_rotations(np.outer(angle, axis), self.ride.rotation[None]))

    def gap(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return `|A - B| - L` (N, n) [m]."""
        between = self.base_points(q) - self.plate_points(plate)
        return np.linalg.norm(between, axis=2) - self.leg_lengths(q)

    def rod_directions(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the unit vectors (N, n, 3) from B to A."""
        between = self.base_points(q) - self.plate_points(plate)
        return between / np.linalg.norm(between, axis=2, keepdims=True)

    def gap_by_pose(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the plate's twist in world axes (N, n, 6): linear, then angular about its origin."""
        unit = self.rod_directions(q, plate)
        arms = self.plate_points(plate) - plate.position[:, None]
        return -np.concatenate([unit, np.cross(arms, unit)], axis=2)

    def gap_by_q(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the actuated positions (N, n, na)."""
        unit = self.rod_directions(q, plate)
        return np.einsum("nki,nkij->nkj", unit, self.base_jacobian(q)) - self.leg_rates(q)

    def gap_by_geometry(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the geometric parameters (N, n, p), columns as `geometry`."""
        q = require_positions(self.robot, q)
        unit = self.rod_directions(q, plate).transpose(1, 2, 0)
        qt = q.T
        at = frames.compute_joint_frames(self.numbers.joints, qt)
        places = frames.compute_points(self.numbers.joints, self.numbers.carried, qt)
        rotation = np.moveaxis(np.asarray(plate.rotation), 0, 2)
        column = {name: k for k, name in enumerate(self.geometry.names)}
        out = np.zeros((len(q), self.n, len(column)))
        for (k, name), value in rod_dimensions.compute_gap_columns(
            self.numbers, at, qt, places, unit, rotation
        ).items():
            out[:, k, column[name]] = value
        return out

    def with_geometry(self, parameters: Parameters) -> Self:
        """Return the robot at other values of some or all geometric parameters; `home` follows."""
        numbers = rod_dimensions.replace_values(self.numbers, parameters)
        given = {p.name: {"value": p.value, "stderr": p.stderr, "origin": p.origin} for p in parameters}
        return replace(
            self,
            numbers=numbers,
            lengths=numbers.lengths,
            on_plate=numbers.on_plate,
            geometry=self.geometry.update(given),
        )

    @cached_property
    def groups(self) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
        """Kinematic chains: which rods hang together because actuators move several of them: (rods, actuators)."""
        touched = [set(self._actuators_of(k)) for k in range(self.n)]
        found: list[tuple[set[int], set[int]]] = []
        for k, actuators in enumerate(touched):
            rods, all_of = {k}, set(actuators)
            apart = []
            for group in found:
                if group[1] & all_of:
                    rods |= group[0]
                    all_of |= group[1]
                else:
                    apart.append(group)
            found = [*apart, (rods, all_of)]
        ordered = sorted(found, key=lambda g: min(g[0]))
        return tuple((tuple(sorted(r)), tuple(sorted(a))) for r, a in ordered)

    def _actuators_of(self, rod: int) -> list[int]:
        joints = self.numbers.joints
        own = [joints[i].actuator for i in frames.list_path(joints, self.numbers.carried.carrier[rod])]
        return own + ([int(self.numbers.slides[rod])] if self.numbers.slides[rod] >= 0 else [])

    def _closed_at_home(self) -> Poses:
        """Return the plate's pose (1 sample) at the home positions, by Newton from the nominal one."""
        home, scale, pose, before = self.robot.home[None], float(np.mean(self.lengths)), self.nominal_home, np.inf
        for _ in range(_MAX_ITERATIONS):
            gap = self.gap(home, pose)[0]
            size = float(np.abs(gap).max()) / scale
            if size < _CLOSED or (
                size < 1e-3 * _CLOSED**0.5 and size >= before
            ):  # closed, or as far as rounding lets it
                return pose
            before = size
            columns = 3 if self.translates else 6
            twist = np.zeros((1, 6))
            twist[0, :columns] = np.linalg.lstsq(self.gap_by_pose(home, pose)[0, :, :columns], -gap, rcond=1e-12)[0]
            large = max(float(np.abs(twist[:, :3]).max()) / scale, float(np.abs(twist[:, 3:]).max()))
            twist *= min(1.0, _STEP / max(large, 1e-300))
            pose = Poses(pose.position + twist[:, :3], turn_rotations(twist[:, 3:], pose.rotation))
        raise LoopClosureError(f"{self.robot.source}: with this geometry the rods cannot be closed at home")

    def __getstate__(self) -> dict[str, object]:
        """Return the geometry alone: a copy, or one sent to another process, starts without solvers."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


SIDES = ("cart", "plate")
DEFAULT_ANGLE = np.deg2rad(45.0)
_TAG = "{urn:tau_dyn}ball_joint"


@dataclass(frozen=True, eq=False)
class BallJoints:
    """The ball joints of a robot's rods.

    Attributes:
        rods: The robot.
        axes: Unit vectors (2, n, 3): of the joints on carts, in the carts' frames, then on the plate, in its frame.
        limits: Largest angles (2, n) [rad]; inf without a ball joint.
        given: Whether the file gives the axis (2, n).
    """

    rods: Legs
    axes: np.ndarray
    limits: np.ndarray
    given: np.ndarray

    def angles(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the angles (N, 2, n) [rad] between rods and joint axes at positions `q` (N, na) and the plate's poses."""
        along = -self.rods.rod_directions(q, plate)
        cart, rotation = _in_carts(self.rods, q, along), np.swapaxes(plate.rotation, 1, 2)
        local = np.stack([cart, np.einsum("nij,nkj->nki", rotation, along)], axis=1)
        return np.arctan2(
            np.linalg.norm(np.cross(self.axes, local), axis=-1), np.einsum("ski,nski->nsk", self.axes, local)
        )


def find_ball_joints(rods: Legs, *, angle: float | None = None) -> BallJoints:
    """Return a robot's ball joints.

    Args:
        rods: The robot.
        angle: Largest angle [rad] of every joint; by default the file's, or 45 degrees if the file has no angle.

    Raises:
        InputError: A hint of the robot file is at fault.
    """
    home = rods.robot.home[None]
    along = -rods.rod_directions(home, rods.home)
    axes = np.stack([_in_carts(rods, home, along)[0], along[0] @ rods.home.rotation[0]])
    limits, given = np.full((2, rods.n), DEFAULT_ANGLE), np.zeros((2, rods.n), bool)
    for side, k, axis, most in _hints(rods):
        if axis is not None:
            axes[side, k], given[side, k] = axis, True
        if most is not None:
            limits[side, k] = most
    if angle is not None:
        limits[:] = angle
    limits[0, _hinged(rods)] = np.inf
    return BallJoints(rods, axes, limits, given)


def _hinged(rods: Legs) -> np.ndarray:
    """Return which rods are sides of a triangle that turns about one axis on its cart: two that end in one point of the plate."""
    same = np.linalg.norm(rods.on_plate[:, None] - rods.on_plate[None], axis=2) < 1e-9
    stem = np.array([name.rpartition("_")[0] for name in rods.names])
    pair = (stem[:, None] == stem[None]) & (stem != "")[:, None]
    return (same & pair).sum(axis=1) > 1


def _in_carts(rods: Legs, q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (N, n, 3) of the world in the frames of the links that carry the rods."""
    at = frames.compute_joint_frames(rods.numbers.joints, q.T)
    out = vectors.copy()
    for k, carrier in enumerate(rods.numbers.carried.carrier):
        if carrier >= 0:
            rotation = np.broadcast_to(np.moveaxis(at[carrier].rotation, 2, 0), (len(q), 3, 3))
            out[:, k] = np.einsum("nji,nj->ni", rotation, vectors[:, k])
    return out


def _hints(rods: Legs) -> list[tuple[int, int, np.ndarray | None, float | None]]:
    where, found = rods.robot.source, []
    for element in fromstring(rods.robot.urdf, forbid_dtd=True).findall(_TAG):
        name, side = element.get("rod", ""), element.get("side", "")
        if name not in rods.names:
            raise UnknownName("rod", name, rods.names, f"{where}: <ball_joint>")
        if side not in SIDES:
            raise InputError(
                "robot_structure", f"{where}: <ball_joint rod='{name}' side='{side}'>: side is cart or plate"
            )
        axis, most = _axis(element.get("axis"), where, name), _angle(element.get("angle"), where, name)
        found.append((SIDES.index(side), rods.names.index(name), axis, most))
    return found


def _axis(text: str | None, where: str, name: str) -> np.ndarray | None:
    if text is None:
        return None
    try:
        axis = np.array([float(word) for word in text.split()])
    except ValueError:
        axis = np.zeros(0)
    size = float(np.linalg.norm(axis))
    if axis.shape != (3,) or not np.isfinite(size) or size < 1e-9:
        raise InputError(
            "robot_structure", f"{where}: <ball_joint rod='{name}' axis='{text}'> must hold three numbers, not all zero"
        )
    return axis / size


def _angle(text: str | None, where: str, name: str) -> float | None:
    if text is None:
        return None
    try:
        angle = float(text)
    except ValueError:
        angle = np.nan
    if not 0 < angle <= np.pi:
        raise InputError(
            "robot_structure", f"{where}: <ball_joint rod='{name}' angle='{text}'> must be between 0 and pi rad"
        )
    return angle
