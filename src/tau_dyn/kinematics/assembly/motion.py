r"""A motion of a parallel robot towards a pose, stopped before anything singular.

The pose is led along a straight line (position) and one turn (orientation); the actuated positions follow by Newton
steps. Between two samples the closure Jacobian `J` (`states.plate_jacobian`) may change by less than half its smallest
singular value, so no matrix on the line between the two is singular (Weyl); the same holds for the actuators' side
`gap_q`. Steps are halved until that is so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.assembly.states import compute_plate_jacobian
from tau_dyn.mechanism import Poses, Rods

_CLOSED = 1e-10  # [m] largest gap of a sample
_CHORDS = 12
"""Newton steps with the Jacobian of the sample before; near as it is, each gains a digit or more."""
_SHARE = 0.5
"""Change of a Jacobian between samples, as a share of its smallest singular value."""
_MIN_STEP_RATIO = 1e-4
"""Shortest step, as a share of the longest, before a motion counts as blocked."""


class Sample(NamedTuple):
    """One point of a motion.

    Attributes:
        q: Actuated positions (na,).
        plate: Pose of the plate (1 sample).
        parallel: Closure Jacobian by the plate's twist (n, n), dimensionless.
        serial: By the actuated positions (n, na).
        margin: Smallest singular values of the two.
    """

    q: np.ndarray
    plate: Poses
    parallel: np.ndarray
    serial: np.ndarray

    margin: tuple[float, float]


class Limits(NamedTuple):
    """What a motion has to keep.

    Attributes:
        lower: Of the actuated positions (na,).
        upper: The same.
        clearance: Smallest distance between two rods that share no point [m]; 0 to let them cross.
        scale: Length that counts as much as a turn by one radian [m].
        longest: Longest step, in those units.
    """

    lower: np.ndarray
    upper: np.ndarray
    clearance: float
    scale: float
    longest: float = 0.1


def sample_at(rods: Rods, q: np.ndarray, plate: Poses) -> Sample:
    """Return the sample at positions (na,) and a pose that fit."""
    parallel, serial = compute_plate_jacobian(rods, q[None], plate)[0], rods.gap_by_q(q[None], plate)[0]
    return Sample(q, plate, parallel, serial, (_smallest(parallel), _smallest(serial)))


def advance(rods: Rods, start: Sample, goal: Poses, limits: Limits, reach: float = np.inf) -> tuple[list[Sample], bool]:
    """Move towards a pose and return the samples after the start, and whether the pose was reached.

    Args:
        rods: The robot.
        start: Where to begin.
        goal: One pose of the plate.
        limits: What to keep.
        reach: Give up after this distance, in the units of `limits.scale`.
    """
    way = float(measure_pose_distances(start.plate, goal, limits.scale)[0])
    if way == 0:
        return [], True
    end = min(1.0, reach / way)
    done, step, motion = 0.0, limits.longest / way, []
    here = start
    while done < end:
        step = min(step, end - done)
        there = _next(rods, here, interpolate_pose(start.plate, goal, done + step), limits)
        if there is None:
            step /= 2
            if step * way < _MIN_STEP_RATIO * limits.longest:
                return motion, False
            continue
        motion.append(there)
        here, done, step = there, done + step, min(2 * step, limits.longest / way)
    return motion, end == 1.0


def measure_pose_distances(a: Poses, b: Poses, scale: float) -> np.ndarray:
    """Return the distances (N,) of poses (N) from one pose: metres over `scale` plus radians."""
    chord = np.linalg.norm(a.rotation - b.rotation, axis=(1, 2)) / np.sqrt(8)  # sin of half the angle between them
    return np.linalg.norm(a.position - b.position, axis=1) / scale + 2 * np.arcsin(np.minimum(chord, 1.0))


def interpolate_pose(a: Poses, b: Poses, share: float) -> Poses:
    """Return the pose at a share of the way from one single pose to another."""
    turn = Rotation.from_matrix(a.rotation[0].T @ b.rotation[0]).as_rotvec()
    rotation = a.rotation[0] @ Rotation.from_rotvec(share * turn).as_matrix()
    return Poses(a.position + share * (b.position - a.position), rotation[None])


def measure_rod_distance(rods: Rods, q: np.ndarray, plate: Poses) -> float:
    """Return the smallest distance [m] between two rods that share no end, at one pose."""
    A, B = rods.base_points(q[None])[0], rods.plate_points(plate)[0]
    i, j = np.triu_indices(rods.n, 1)
    own = (np.linalg.norm(A[i] - A[j], axis=1) > 1e-9) & (np.linalg.norm(B[i] - B[j], axis=1) > 1e-9)
    return float(_segments(A[i[own]], B[i[own]], A[j[own]], B[j[own]]).min(initial=np.inf))


def _next(rods: Rods, here: Sample, pose: Poses, limits: Limits) -> Sample | None:
    """Return the sample at a pose nearby, or None where it breaks a limit or is too far to be sure."""
    q = here.q
    for _ in range(_CHORDS):
        gap = rods.gap(q[None], pose)[0]
        if not np.isfinite(gap).all():
            return None
        if np.abs(gap).max() < _CLOSED:
            break
        q = q - np.linalg.solve(here.serial, gap)  # regular, or the search would not be here
    else:
        return None
    if (q < limits.lower - 1e-9).any() or (q > limits.upper + 1e-9).any():
        return None
    there = sample_at(rods, q, pose)
    if limits.clearance and measure_rod_distance(rods, q, pose) < limits.clearance:
        return None
    return there if is_regular_between(here, there) else None


def is_regular_between(a: Sample, b: Sample) -> bool:
    """Return whether no Jacobian on the line between two samples' is singular."""
    pairs = zip((a.parallel, a.serial), (b.parallel, b.serial), a.margin, b.margin, strict=True)
    return all(np.linalg.norm(first - second) < _SHARE * min(margins) for first, second, *margins in pairs)


def _smallest(J: np.ndarray) -> float:
    return float(np.linalg.svd(J, compute_uv=False)[-1])


def _segments(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return distances (m,) of segments a-b and c-d (m, 3) (Ericson 2005, section 5.1.9)."""
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    ur, vr = (u * r).sum(1), (v * r).sum(1)
    det = uu * vv - uv**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(det > 1e-14 * uu * vv, np.clip((uv * vr - vv * ur) / det, 0, 1), 0.0)
    t = (uv * s + vr) / vv
    s = np.where((t < 0) | (t > 1), np.clip((uv * np.clip(t, 0, 1) - ur) / uu, 0, 1), s)
    return np.linalg.norm(r + s[:, None] * u - np.clip(t, 0, 1)[:, None] * v, axis=1)
