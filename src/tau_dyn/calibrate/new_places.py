"""Held-out distances and touches at places without training poses: a hole that was not used, a wire's end that was moved.

Such a place is fitted to its own held-out rows, at the calibrated dimensions and target. Each row is tested at the place fitted
to the others, `(I - H_ii)^-1 r_i`, with `H` the hat matrix of the place. Reference: Belsley, Kuh & Welsch 1980 (leverage).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.measured import KINDS, PoseSet
from tau_dyn.calibrate.starting_frames import place_alone
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses

_MAX_DISTANCE = 10.0  # standard errors, or medians of the residuals, beyond which a row does not place the others
_OPEN = 1e-6  # singular value, over the largest, of a number of the place that its rows do not show


class NewPlace(NamedTuple):
    """A place fitted to its own rows.

    Attributes:
        own: Which poses were measured at the place (N,).
        poses: Those poses (n), with the one device in `frames`.
        frames: Frame of the place, and all targets.
        residuals: Residual of each row (n, 3) [m], predicted by the others.
        slope: Derivative (n, 3, r) by the components of the place that its rows determine, orthonormal over the fitted rows.
        kept: Rows to which the place is fitted (n,).
    """

    own: np.ndarray
    poses: PoseSet
    frames: DeviceFrames
    residuals: np.ndarray
    slope: np.ndarray
    kept: np.ndarray

    def remove(self, columns: np.ndarray) -> np.ndarray:
        """Return derivatives (n, 3, p) of the rows without the part that a change of the place explains."""
        return columns - np.einsum("nir,mjr,mjp->nip", self.slope, self.slope[self.kept], columns[self.kept])


def find_new_places(poses: PoseSet, base: Poses, known: int, frames: DeviceFrames, noise: float) -> list[NewPlace]:
    """Return the places of devices beyond the known ones.

    Args:
        poses: Held-out poses (N).
        base: Predicted tool poses there (N) in the robot's base frame.
        known: Number of devices with training poses.
        frames: Fitted frames; their targets count.
        noise: Standard error of a measured coordinate [m].

    Raises:
        InputError: A place has too few rows for its own numbers.
    """
    return [
        _find_place(poses, base, poses.device == number, frames, noise) for number in range(known, len(poses.devices))
    ]


def _find_place(poses: PoseSet, base: Poses, own: np.ndarray, frames: DeviceFrames, noise: float) -> NewPlace:
    """Return the place of one device."""
    number = int(poses.device[own][0])
    kind, n = poses.kinds[number], int(own.sum())
    rows, zero = poses.take(own), np.zeros(n, int)
    by_campaign = len(frames.tool) > len(poses.targets)  # then a target moved between campaigns
    some = replace(
        rows,
        devices=(poses.devices[number],),
        kinds=(kind,),
        device=zero,
        device_errors=(),
        campaign=zero,
        campaigns=("1",),
        target=rows.campaign if by_campaign else rows.target,
        targets=rows.campaigns if by_campaign else rows.targets,
    )
    at, shown = base.take(own), len(KINDS[kind].axes) + bool(KINDS[kind].length)
    ok = np.isfinite(at.position.sum(axis=1))
    found = _place_robustly(some, at, ok, shown, frames.tool, noise)
    if found is None:
        raise InputError(
            "too_little_data",
            f"{poses.source}: {poses.devices[number]} is not among the training poses, and its {n} rows do not show its place "
            f"and leave one over; at least {-(-shown // KINDS[kind].numbers) + 1} in different attitudes are needed",
        )
    return NewPlace(own, some, *found)


def _place_robustly(
    poses: PoseSet, base: Poses, ok: np.ndarray, shown: int, targets: tuple[Frame, ...], noise: float
) -> tuple[DeviceFrames, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the place fitted to the rows that agree, the result of `_leave_out_each`, and these rows; None if too few agree."""
    kept, placed = ok, None
    for robust in (noise, None, None):
        if kept.sum() * KINDS[poses.kinds[0]].numbers <= shown:
            return None
        known = Predicted(base.take(kept), kept[kept], np.full(int(kept.sum()), ""))
        placed = place_alone(poses.take(kept), known, targets, robust)
        off = np.linalg.norm(_compute_residuals(poses, base, placed), axis=1)
        kept = ok & (off < np.maximum(_MAX_DISTANCE * noise, _MAX_DISTANCE * np.median(off[kept])))
    assert placed is not None
    found = _leave_out_each(poses, base, kept, placed)
    return None if found is None else (placed, *found, kept)


def _compute_residuals(poses: PoseSet, base: Poses, frames: DeviceFrames) -> np.ndarray:
    """Return measured minus predicted (N, 3) [m] at a place."""
    return poses.compute_position_residuals(frames.measured(base, poses.setup), frames.lengths_of(poses.setup))


def _leave_out_each(
    poses: PoseSet, base: Poses, kept: np.ndarray, frames: DeviceFrames
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return residuals (N, 3) of each row by the place of the others, and the slope; None if one row alone gives a component."""
    seen = frames.measured(base, poses.setup)
    device = frames.columns(base, seen, poses.setup)[0]
    shown = device[:, :, list(KINDS[poses.kinds[0]].axes)]
    columns = np.concatenate([shown, frames.length_columns(poses, seen.position)], axis=2)
    columns = np.nan_to_num(poses.project_columns(seen, columns)[:, :3])
    _, s, vt = np.linalg.svd(columns[kept].reshape(-1, columns.shape[2]), full_matrices=False)
    shows = s > _OPEN * s[0]
    slope = columns @ (vt[shows].T / s[shows])
    left = np.eye(3) - np.where(kept[:, None, None], slope @ np.swapaxes(slope, 1, 2), 0.0)
    if np.linalg.eigvalsh(left).min() < _OPEN:
        return None
    return np.linalg.solve(left, _compute_residuals(poses, base, frames)[:, :, None])[:, :, 0], slope
