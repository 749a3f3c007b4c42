r"""A plate on legs as points and distances: `|A_k(q) - B_k(X)| = L_k` (thesis (4.4), (4.14); Merlet 2006, ch. 2).

Actuated chains carry points A, the plate at pose X carries points B, rods hold their distance. Forward and inverse
kinematics, Jacobians and calibration know the robot through these rows alone. Public arrays have samples first; what the
solvers use (`chains.py`, `rod_dimensions.py`) has samples last.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism import chains, rod_dimensions
from tau_dyn.mechanism.plate_arrays import rotate_by_vector
from tau_dyn.mechanism.poses import Poses
from tau_dyn.mechanism.positions import require_positions
from tau_dyn.mechanism.rod_dimensions import RodDimensions
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

_CLOSED = 1e-12  # relative to the rods
_MAX_ITERATIONS = 30  # Newton steps from the file's pose
_STEP = 0.2  # of the rods' length or rad


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
        return chains.compute_points(self.numbers.joints, self.numbers.carried, q.T).transpose(2, 0, 1)

    def base_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return `dA/dq` (N, n, 3, na)."""
        q = require_positions(self.robot, q).T
        joints, carried = self.numbers.joints, self.numbers.carried
        at, places = chains.compute_joint_frames(joints, q), chains.compute_points(joints, carried, q)
        out = np.zeros((q.shape[1], self.n, 3, self.na))
        for (k, actuator), column in chains.compute_velocities(joints, carried, at, places).items():
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
        at = chains.compute_joint_frames(self.numbers.joints, qt)
        places = chains.compute_points(self.numbers.joints, self.numbers.carried, qt)
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
        own = [joints[i].actuator for i in chains.list_path(joints, self.numbers.carried.carrier[rod])]
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
            twist = np.zeros((6, 1))
            twist[:columns, 0] = np.linalg.lstsq(self.gap_by_pose(home, pose)[0, :, :columns], -gap, rcond=1e-12)[0]
            large = max(float(np.abs(twist[:3]).max()) / scale, float(np.abs(twist[3:]).max()))
            twist *= min(1.0, _STEP / max(large, 1e-300))
            turned = rotate_by_vector(twist[3:], np.moveaxis(pose.rotation, 0, 2))
            pose = Poses(pose.position + twist[:3].T, np.moveaxis(turned, 2, 0))
        raise LoopClosureError(f"{self.robot.source}: with this geometry the rods cannot be closed at home")

    def __getstate__(self) -> dict[str, object]:
        """Return the geometry alone: a copy, or one sent to another process, starts without solvers."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
