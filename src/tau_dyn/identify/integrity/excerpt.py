"""A short, even, low-passed excerpt of the logs on which their wiring and timing are judged against the robot file.

Positions and forces pass the same zero-phase low-pass and are decimated to its bandwidth; reversals, speeds within the encoder's
noise and forces at the drives' limits are masked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.preparation import choose_preparation, find_excluded_samples, find_unsure_samples, widen
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    Log,
    compute_edge_samples,
    compute_noise_gain,
    decimate,
    differentiate,
    estimate_encoder_noise,
    lowpass,
)
from tau_dyn.robot import Robot

MAX_DURATION_S = 60.0
"""Length of the middle part of a log that is used [s]; a motion repeats itself."""

MAX_SAMPLES = 3000
"""Number of decimated samples used: more do not change a verdict, and two seconds are enough for a check."""

NOISE_FACTOR = 10.0
"""Speeds below so many standard deviations of their noise have no sure sign."""

MASK_PERIODS = 1.0
"""Time masked on both sides of a reversal, in periods of the low-pass: longer than friction's step is smeared."""

MAX_SATURATED = 0.05
"""Share of forces at the robot file's limits above which the limits are ignored."""

MIN_SAMPLES = 40
"""With fewer usable samples of all joints together, no statement is made."""

MAX_COMPUTED = 1e-6
"""Relative difference from differentiated positions below which a velocity was computed from them."""

MIN_COHERENCE = 0.95
"""Correlation from which a recorded velocity is that of the joint; noise of sensors leaves more, another joint less."""


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Even samples of one log at the rate of the low-pass.

    Attributes:
        log: The even log of the excerpt, at its own rate.
        q: Positions (n, na) [m or rad].
        v: Velocities (n, na).
        a: Accelerations (n, na).
        tau: Forces (n, na) [N or N m].
        used: Which samples have a sure direction and a force within the drive's limits (n, na).
        dt: Time between samples [s].
        cutoff_hz: Cutoff of the low-pass [Hz].
    """

    log: Log
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    used: np.ndarray
    dt: float
    cutoff_hz: float


@dataclass(frozen=True, eq=False)
class Records:
    """Properties of a whole log by which its readings are judged.

    Attributes:
        speed_ratio: Recorded velocity over the derivative of the position (na,); nan without an independent record.
        mean_force: Mean of each force over the whole log (na,) [N or N m].
        force_deviation: Standard deviation of each force (na,) [N or N m].
    """

    speed_ratio: np.ndarray
    mean_force: np.ndarray
    force_deviation: np.ndarray

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt, log: Log | None = None) -> Records:
        """Take the velocities of an excerpt and the forces of the whole log."""
        tau = (excerpt.log if log is None else log).joint("tau", robot.actuated)
        ratio = np.array([_compare_speeds(excerpt, k, joint) for k, joint in enumerate(robot.actuated)])
        return cls(ratio, tau.mean(axis=0), tau.std(axis=0))


def _compare_speeds(excerpt: Excerpt, k: int, joint: str) -> float:
    """Return the slope of a joint's recorded velocity over the derivative of its position; nan without an independent record."""
    log = excerpt.log
    if not log.has("v", [joint]):
        return np.nan
    raw, q = log.joint("v", [joint])[:, 0], log.joint("q", [joint])[:, 0]
    size = float(np.sqrt(np.mean(raw**2)))
    differences = (np.gradient(q, log.dt)[1:-1], np.diff(q)[1:] / log.dt, np.diff(q)[:-1] / log.dt)
    if any(np.sqrt(np.mean((raw[1:-1] - x) ** 2)) < MAX_COMPUTED * size for x in differences):
        return np.nan  # computed from the positions with the log's own clock
    factor = max(1, round(excerpt.dt / log.dt))
    recorded = decimate(lowpass(raw[:, None], excerpt.cutoff_hz, log.rate_hz), factor)[:, 0]
    used = excerpt.used[:, k]
    v, recorded = excerpt.v[used, k], recorded[: len(used)][used]
    if used.sum() < MIN_SAMPLES or not np.any(v) or not np.any(recorded):
        return np.nan
    slope = float(v @ recorded / (v @ v))
    coherence = abs(v @ recorded) / np.sqrt((v @ v) * (recorded @ recorded))
    return slope if coherence > MIN_COHERENCE else np.nan


def make_excerpt(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...] = ()) -> Excerpt | None:
    """Return the excerpt of the longest of even logs; None if they are too short or do not move.

    Args:
        robot: Gives the actuated joints and their limits.
        logs: Even stretches with `q` and `tau` of every joint.
        exclude: Columns whose nonzero samples are left out.
    """
    joints = robot.actuated
    fit = [
        log for log in logs if log.has("q", joints) and log.has("tau", joints) and log.n_samples > MIN_SEGMENT_SAMPLES
    ]
    if not fit:
        return None
    log = max(fit, key=lambda piece: piece.duration)
    if log.duration > MAX_DURATION_S:
        middle, half = log.n_samples // 2, int(MAX_DURATION_S / 2 / log.dt)
        if half == 0:  # a clock in another unit: steps of minutes and more
            return None
        log = log.window(max(0, middle - half), middle + half)
    try:
        preparation = choose_preparation(robot, [log], exclude)
        return _filtered(robot, log, preparation.force_cutoff_hz, exclude)
    except (CannotAnswer, InputError):
        return None


def _filtered(robot: Robot, log: Log, cutoff: float, exclude: tuple[str, ...]) -> Excerpt | None:
    joints, rate = robot.actuated, log.rate_hz
    cutoff = min(cutoff, MAX_SAMPLES / (4 * log.duration), 0.2 * rate)
    raw = log.joint("q", joints)
    q, tau = lowpass(raw, cutoff, rate), lowpass(log.joint("tau", joints), cutoff, rate)
    v = differentiate(q, log.dt, accuracy=4)
    a = differentiate(v, log.dt, accuracy=4)
    threshold = np.maximum(
        NOISE_FACTOR * estimate_encoder_noise(raw) * compute_noise_gain(rate, cutoff), 0.005 * np.abs(v).max(axis=0)
    )
    shut = find_unsure_samples(v, threshold)
    left_out = find_excluded_samples(log, joints, robot.effort_limit, exclude)
    if np.mean(left_out) > MAX_SATURATED:  # forces in another unit, or meaningless limits
        left_out = find_excluded_samples(log, joints, np.full(robot.na, np.inf), exclude)
    shut |= left_out
    used = ~widen(shut, int(np.ceil(MASK_PERIODS * rate / cutoff)))
    edge = compute_edge_samples(cutoff, rate)
    used[:edge] = used[len(used) - edge :] = False
    factor = max(1, int(rate / (4 * cutoff)))
    used = used[::factor]
    q, v, a, tau = (decimate(x, factor) for x in (q, v, a, tau))
    if used.sum() < MIN_SAMPLES:
        return None
    return Excerpt(log, q, v, a, tau, used, factor * log.dt, cutoff)


def compute_clipped_power(r: np.ndarray, deviations: float) -> float:
    """Return the mean square of residuals (n,), clipped at so many robust standard deviations."""
    if not r.size:
        return 0.0
    limit = deviations * 1.4826 * float(np.median(np.abs(r)))
    return float(np.mean(np.minimum(r**2, limit**2))) if limit > 0 else float(np.mean(r**2))
