"""The rod ends of a parallel robot at some positions, laws on top, and how the gaps of its rods change with everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tau_dyn.calibrate.drive_and_guide_laws import DriveLaw, GuideLaw
from tau_dyn.calibrate.rod_numbers import TurnedNumbers, right_jacobian
from tau_dyn.mechanism import (
    ChainJoint,
    Poses,
    RodDimensions,
    compute_gap_columns,
    compute_leg_lengths,
    compute_leg_rates,
    frames,
)


class PlacedRods:
    """Points A of a geometry at some positions, everything evaluated once; arrays of chains have samples last."""

    def __init__(
        self,
        numbers: RodDimensions,
        drives: Sequence[DriveLaw],
        guides: Sequence[GuideLaw],
        laws: Mapping[int, np.ndarray],
        q: np.ndarray,
    ) -> None:
        """Place the points at positions `q` (N, na); `laws` holds each law's values by its place in `drives + guides`."""
        self.numbers = numbers
        self.q = q
        self.drive_shifts = [law.drive(laws[k], q) for k, law in enumerate(drives)]
        self.effective = q.copy()
        for law, shift in zip(drives, self.drive_shifts, strict=True):
            self.effective[:, law.actuator] += shift.error
        self.guide_shifts = [law.guide(laws[len(drives) + k], q) for k, law in enumerate(guides)]
        self.moving = np.ascontiguousarray(self.effective.T)
        self.frames = frames.compute_joint_frames(self.numbers.joints, self.moving)
        self.places = frames.compute_points(self.numbers.joints, self.numbers.carried, self.moving)
        self.points = self.places.transpose(2, 0, 1) + sum(s.shift for s in self.guide_shifts)
        self.lengths = np.broadcast_to(compute_leg_lengths(self.numbers, self.moving).T, self.points.shape[:2])

    def _between(self, plate: Poses) -> tuple[np.ndarray, np.ndarray]:
        arms = self.numbers.on_plate @ np.swapaxes(plate.rotation, 1, 2)
        return self.points - plate.position[:, None] - arms, arms

    def gap(self, plate: Poses) -> np.ndarray:
        """Return `|A - B| - L` (N, n)."""
        return np.linalg.norm(self._between(plate)[0], axis=2) - self.lengths

    def directions(self, plate: Poses) -> np.ndarray:
        """Return unit vectors from B to A (N, n, 3)."""
        between, _ = self._between(plate)
        return between / np.linalg.norm(between, axis=2, keepdims=True)

    def by_pose(self, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the plate's twist (N, n, 6)."""
        between, arms = self._between(plate)
        unit = between / np.linalg.norm(between, axis=2, keepdims=True)
        return -np.concatenate([unit, np.cross(arms, unit)], axis=2)

    def columns(self, unit: np.ndarray, plate: Poses) -> dict[tuple[int, str], np.ndarray]:
        """Return the gaps' derivatives by the dimensions."""
        rotation = np.moveaxis(np.asarray(plate.rotation), 0, 2)
        return compute_gap_columns(
            self.numbers, self.frames, self.moving, self.places, unit.transpose(1, 2, 0), rotation
        )

    def turning(self) -> list[tuple[ChainJoint, int]]:
        """Return the turning joints and their places in the chain list."""
        return [(j, k) for k, j in enumerate(self.numbers.joints) if not j.slides]

    def by_turn(self, joint: ChainJoint, place: int, unit: np.ndarray) -> list[tuple[int, np.ndarray]]:
        r"""Return, rod by rod on this joint, the gap's derivative (N, 3) by its `turn`.

        The frame is `S = R_parent R_0 Exp(t)`; a change of `t` turns all behind it by `S J_r(t) dt` about the joint's
        origin.
        """
        parent = self.frames[joint.parent].rotation if joint.parent >= 0 else np.eye(3)[:, :, None]
        frame = (
            frames.multiply_by_constant(parent, joint.rotation)
            if parent.shape[2] > 1
            else (parent[:, :, 0] @ joint.rotation)[:, :, None]
        )
        origin = self.frames[place].origin
        turn = self.numbers.turn(joint.name) if isinstance(self.numbers, TurnedNumbers) else np.zeros(3)
        found = []
        for k, carrier in enumerate(self.numbers.carried.carrier):
            if place in frames.list_path(self.numbers.joints, carrier):
                arm = self.places[k] - origin
                moment = np.cross(arm.T, unit[:, k])  # u . (w x arm) = w . (arm x u)
                own = np.einsum("ijn,ni->nj", np.broadcast_to(frame, (3, 3, len(moment))), moment)
                found.append((k, own @ right_jacobian(turn)))
        return found

    def by_effective_joint(self, unit: np.ndarray) -> np.ndarray:
        """Return the gaps' derivative by positions after the drives (N, n, na)."""
        out = np.zeros((*unit.shape[:2], self.q.shape[1]))
        for (k, a), column in frames.compute_velocities(
            self.numbers.joints, self.numbers.carried, self.frames, self.places
        ).items():
            out[:, k, a] = np.einsum("ni,in->n", unit[:, k], np.broadcast_to(column, (3, len(unit))))
        rates = np.broadcast_to(compute_leg_rates(self.numbers, self.moving), (unit.shape[1], len(unit)))
        for k in np.flatnonzero(self.numbers.slides >= 0):
            out[:, k, self.numbers.slides[k]] -= rates[k]
        return out
