r"""A parallel robot of points and distances as a `Geometry`: `|A_k(q) - B_k(X)| = L_k` (thesis (4.14)), laws on top.

Parameters are those of `kinematics.geometry`, except that a turning joint has, instead of an axis of free length, the
orientation of its
frame: `<joint>.turn_x/y/z`, a rotation vector after the nominal orientation, in the frame's own axes. So a joint's
axis and its zero are both free, its gear is not, and no quaternion has to be kept at norm 1 (thesis 5.4 left its four
numbers free). Every law adds its own. The tool's frame on the plate is part of the target's (`tool.x` ..), since
plate points are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.drive_and_guide_laws import DriveLaw, GuideLaw
from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.placed_rods import PlacedRods
from tau_dyn.calibrate.rod_numbers import TURN, compute_dimensions_at
from tau_dyn.mechanism import Poses, RodDimensions, Rods, forward_kinematics
from tau_dyn.parameters import Parameter, Parameters

_STEPS = 12  # Newton steps to a pose
_AT_REST = 1e-9  # [m or rad]: after a step this small the next one, a quadratic one, would be rounding
_CLOSED = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class RodGeometry:
    """A parallel robot with free dimensions.

    Attributes:
        rods: The nominal robot.
        drives: Errors of actuated positions.
        guides: Displacements of rod ends.
    """

    rods: Rods
    drives: tuple[DriveLaw, ...] = ()
    guides: tuple[GuideLaw, ...] = ()

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints."""
        return self.rods.robot.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`."""
        return self.rods.robot.position_units

    @property
    def orients(self) -> bool:
        """Whether the plate turns."""
        return not self.rods.translates

    @property
    def parameters(self) -> Parameters:
        """Dimensions, then the laws'."""
        return self._parameters

    @property
    def priority(self) -> np.ndarray:
        """Lengths and laws first, then points of plate and base, joints; the first guideway last: it fixes the base frame."""
        return self._priority

    @cached_property
    def _parameters(self) -> Parameters:
        turning = {j.name for j in self.rods.numbers.joints if not j.slides}
        rows: list[Parameter] = []
        for p in self.rods.geometry:
            owner, _, what = p.name.rpartition(".")
            if owner in turning and what.startswith("axis_"):
                rows.append(Parameter(f"{owner}.{TURN}_{what[-1]}", 0.0, "rad"))
            else:
                rows.append(p)
        for law in (*self.drives, *self.guides):
            rows += list(law.parameters)
        return Parameters(rows)

    @cached_property
    def _priority(self) -> np.ndarray:
        joints = self.rods.numbers.joints
        first = "arm1" if self.rods.numbers.arms else joints[0].name if joints else ""
        return np.array([_priority(name, first) for name in self.parameters.names], int)

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses: Newton from `start`, or from where the nominal robot is."""
        at = self._at(theta, q)
        if start is None:
            found = forward_kinematics(self.rods, q)
            start = Poses(found.poses.position, found.poses.rotation)
        plate, ok = self._newton(at, self.rods.plate_poses(start))
        tool = self.rods.tool_poses(plate)
        position = np.where(ok[:, None], tool.position, np.nan)
        rotation = np.where(ok[:, None, None], tool.rotation, np.nan)
        return Predicted(Poses(position, rotation), ok, np.where(ok, "", "out of reach"))

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        at = self._at(theta, q)
        plate = self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_parameter(at, plate))

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na)."""
        at = self._at(theta, q)
        plate = self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_joint(at, plate))

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the gaps `|A - B| - L` (N, n) [m]."""
        return self._at(theta, q).gap(self.rods.plate_poses(poses))

    def closure_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the gaps' derivative by the parameters (N, n, p)."""
        return self._by_parameter(self._at(theta, q), self.rods.plate_poses(poses))

    def closure_by_pose(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the gaps' derivative by the tool's twist (N, n, 6)."""
        plate = self.rods.plate_poses(poses)
        by_plate = self._at(theta, q).by_pose(plate)
        arm = plate.rotation @ self.rods.tool.translation
        turned = by_plate[:, :, 3:] - np.cross(by_plate[:, :, :3], -arm[:, None]) if arm.any() else by_plate[:, :, 3:]
        return np.concatenate([by_plate[:, :, :3], turned], axis=2)

    def closure_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the gaps' derivative by the actuated joints (N, n, na)."""
        return self._by_joint(self._at(theta, q), self.rods.plate_poses(poses))

    def numbers(self, theta: np.ndarray) -> RodDimensions:
        """Return the robot's dimensions at these parameters, without the laws."""
        values = dict(zip(self.parameters.names, np.asarray(theta, float).tolist(), strict=True))
        return compute_dimensions_at(self.rods.numbers, values)

    def rods_at(self, theta: np.ndarray) -> Rods:
        """Return the robot with these dimensions, without the laws."""
        numbers = self.numbers(theta)
        return replace(self.rods, numbers=numbers, lengths=numbers.lengths, on_plate=numbers.on_plate)

    def law_values(self, theta: np.ndarray) -> dict[int, np.ndarray]:
        """Return each law's part of the parameters, by its place in `drives + guides`."""
        k, found = len(self.rods.geometry), {}
        for place, law in enumerate((*self.drives, *self.guides)):
            n = len(law.parameters)
            found[place] = theta[k : k + n]
            k += n
        return found

    def _at(self, theta: np.ndarray, q: np.ndarray) -> PlacedRods:
        theta = np.asarray(theta, float)
        return PlacedRods(self.numbers(theta), self.drives, self.guides, self.law_values(theta), np.asarray(q, float))

    def _newton(self, at: PlacedRods, plate: Poses) -> tuple[Poses, np.ndarray]:
        """Return plate poses that close the rods, and where they do (N,)."""
        position, rotation = plate.position.copy(), plate.rotation.copy()
        lost = ~(np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2)))
        position[lost], rotation[lost] = self.rods.home.position[0], self.rods.home.rotation[0]
        size = float(np.mean(self.rods.lengths))
        for _ in range(_STEPS):
            here = Poses(position, rotation)
            step = -self._solve(at.by_pose(here), at.gap(here)[:, :, None])[:, :, 0]
            step = np.where(np.isfinite(step), step, 0.0)
            long = np.linalg.norm(step[:, :3], axis=1) / (0.3 * size)
            step /= np.maximum(1.0, long)[:, None]
            position = position + step[:, :3]
            if not self.rods.translates:
                rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            if np.abs(step).max(initial=0.0) < _AT_REST:
                break
        here = Poses(position, rotation)
        return here, np.abs(at.gap(here)).max(axis=1, initial=0.0) < _CLOSED

    def _solve(self, by_pose: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return plate twists (N, 6, k) for rows (N, n, k)."""
        rows = 3 if self.rods.translates else 6
        j = by_pose[:, :, :rows]
        if j.shape[1] != rows:  # more rods than freedoms: the best in the least-squares sense
            turned = np.swapaxes(j, 1, 2)
            j, right = turned @ j, turned @ right
        try:
            found = np.linalg.solve(j, right)
        except np.linalg.LinAlgError:  # one pose is singular; the others still have their answer
            found = np.linalg.pinv(j) @ right
        out = np.zeros((len(by_pose), 6, right.shape[2]))
        out[:, :rows] = found
        return out

    def _tool_twist(self, at: PlacedRods, plate: Poses, columns: np.ndarray) -> np.ndarray:
        twist = -self._solve(at.by_pose(plate), columns)
        arm = plate.rotation @ self.rods.tool.translation
        if arm.any():
            twist[:, :3] += np.cross(twist[:, 3:], arm[:, :, None], axis=1)
        return twist

    def _by_parameter(self, at: PlacedRods, plate: Poses) -> np.ndarray:
        index = {name: k for k, name in enumerate(self.parameters.names)}
        out = np.zeros((len(at.q), self.rods.n, len(index)))
        unit = at.directions(plate)
        for (k, name), value in at.columns(unit, plate).items():
            if name in index:
                out[:, k, index[name]] = value
        for joint, place in at.turning():
            for k, column in at.by_turn(joint, place, unit):
                first = index[f"{joint.name}.{TURN}_x"]
                out[:, k, first : first + 3] = column
        k = len(self.rods.geometry)
        by_q = at.by_effective_joint(unit) if self.drives else None
        for law, shift in zip(self.drives, at.drive_shifts, strict=True):
            assert by_q is not None
            n = shift.columns.shape[1]
            out[:, :, k : k + n] = by_q[:, :, law.actuator, None] * shift.columns[:, None]
            k += n
        for shift in at.guide_shifts:
            n = shift.columns.shape[3]
            out[:, :, k : k + n] = np.einsum("nki,nkip->nkp", unit, shift.columns)
            k += n
        return out

    def _by_joint(self, at: PlacedRods, plate: Poses) -> np.ndarray:
        unit = at.directions(plate)
        out = at.by_effective_joint(unit)
        for law, shift in zip(self.drives, at.drive_shifts, strict=True):
            out[:, :, law.actuator] *= 1 + shift.slope[:, None]
        for law, shift in zip(self.guides, at.guide_shifts, strict=True):
            out[:, :, law.actuator] += np.einsum("nki,nki->nk", unit, shift.slope)
        return out


def _priority(name: str, first: str) -> int:
    owner, _, what = name.rpartition(".")
    stem = what.rpartition("_")[0] or what
    if stem in ("length", "drift", "guideway", "drive") or stem.startswith(("bend", "error")):
        return 0
    order: Sequence[str] = ("plate", "base", "direction", "turn", "origin")
    level = 1 + order.index(stem) if stem in order else 1
    return level + (10 if owner == first else 0)
