"""Filters for finding causes, chosen from the logs themselves: how wide forces and positions are let through, at which rate.

Causes act far above the motion's own band, so forces and positions are filtered wider than for an identification, as far as the
encoders' noise allows; the positions from which columns are made are filtered at what stands above that noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.scenes import compute_fast_speeds
from tau_dyn.identify import (
    CODE,
    NOISE_FACTOR,
    RATE_FACTOR,
    Kept,
    Preparation,
    TooShort,
    choose_from_long,
    choose_preparation,
    keep_long,
    refuse_short,
)
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    Log,
    compute_edge_samples,
    compute_noise_gain,
    decimate,
    differentiate,
    estimate_encoder_noise,
    find_motion_band,
    lowpass,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

BAND_FACTOR = 20.0
"""Highest frequency looked at, in edges of the motion's own band; a tooth passes many times in one stroke."""
SLOW_SHARE = 0.01  # speed at which a joint's direction has to be known, as a share of its fast speed
MIN_DIRECTION_SNR = 5.0
"""Speeds whose direction is sure, in the velocity's noise."""
REVERSAL_GAP_PERIODS = 1.0
"""Time gated out beside a reversal, in periods of the position filter: a joint may rest for half a period unseen, its friction
anywhere between both directions, and the filter spreads the start over as much again. Rests passed for hysteresis and delays."""
OVERSAMPLING = 5.0
"""Rate of a log that is worth keeping, in cutoffs of the position filter."""
SMOOTH_FACTOR = 2.0
"""Of the frequency up to which the motion stands above the encoder's noise; a wider filter lets noise into the columns."""


def choose_diagnosis_preparation(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...]) -> Preparation:
    """Choose filters for finding causes, which may act far above the motion's own band.

    The band of the forces is as wide as encoder noise allows: above it, that noise times a mass is all there is to see, and a
    noise model spends itself on it. Positions are low-passed as widely as leaves ten times the velocity's noise below 1 % of
    the fast speeds, so that reversals are seen sharply.
    """
    plain = choose_preparation(robot, logs, exclude)
    rate = min(log.rate_hz for log in logs)
    q = [log.joint("q", robot.actuated) for log in logs]
    noise = np.max([estimate_encoder_noise(x) for x in q], axis=0)
    fast = np.max([_fast(x, plain.position_cutoff_hz, log) for x, log in zip(q, logs, strict=True)], axis=0)
    moving = fast > plain.speed_threshold
    cutoffs = np.geomspace(min(2 * plain.force_cutoff_hz, 0.4 * rate), 0.4 * rate, 40)
    gains = np.array([compute_noise_gain(rate, f) for f in cutoffs])
    allowed = SLOW_SHARE * fast[moving] / np.maximum(NOISE_FACTOR * noise[moving], 1e-300)
    within = gains <= allowed.min() if moving.any() else np.ones(1, bool)
    position_cutoff = float(cutoffs[max(0, int(within.sum()) - 1)])
    bands = [find_motion_band(x, log.rate_hz) for x, log in zip(q, logs, strict=True)]
    edge = max(float(band.edge_hz.max()) for band in bands)
    noise_edge = min((float(e) for b in bands for e in b.noise_edge_hz[b.edge_hz > 0]), default=rate)
    force_cutoff = max(plain.force_cutoff_hz, min(0.16 * rate, BAND_FACTOR * edge, noise_edge))
    threshold = MIN_DIRECTION_SNR * noise * compute_noise_gain(rate, position_cutoff)
    return Preparation(
        position_cutoff,
        force_cutoff,
        RATE_FACTOR * force_cutoff,
        threshold,
        REVERSAL_GAP_PERIODS / position_cutoff,
        exclude,
    )


def keep_diagnosable(
    robot: Robot, logs: Sequence[Log], train: Sequence[Log], held: Sequence[Log], exclude: tuple[str, ...]
) -> tuple[list[Log], list[Log], tuple[str, ...]]:
    """Return the pieces that are long enough for every filter of a diagnosis, and what is said of the others.

    Args:
        robot: Gives the actuated joints.
        logs: What the training pieces are cut from.
        train: Pieces of the training logs; the filters are chosen from them.
        held: Pieces of held-out logs; they may all be too short.
        exclude: Log columns whose nonzero samples are left out.

    Raises:
        TooShort: No training piece is long enough.
    """
    if not train:
        raise refuse_short(logs, MIN_SEGMENT_SAMPLES / min((log.rate_hz for log in logs), default=1.0))
    long: list[Log] = []
    plain = choose_from_long(train, lambda found: choose_preparation(robot, long.extend(found) or found, exclude))
    lowest_hz = min(plain.force_cutoff_hz, clear_cutoff(robot, long), smooth_cutoff(robot, long))
    kept = keep_long(train, lowest_hz, plain.factor)
    try:
        kept_held = keep_long(held, lowest_hz, plain.factor) if held else Kept((), ())
    except TooShort as fault:
        kept_held = Kept((), (CodedWarning(CODE, fault.missing),))
    return kept.of(train), kept_held.of(held), (*kept.warnings, *kept_held.warnings)


def _fast(q: np.ndarray, cutoff_hz: float, log: Log) -> np.ndarray:
    """Return the speed that each joint exceeds in 2 % of the samples (na,)."""
    v = differentiate(lowpass(q, cutoff_hz, log.rate_hz), log.dt)
    return compute_fast_speeds(v)


def decimate_log(log: Log, cutoff_hz: float) -> Log:
    """Return a log at a lower rate, where it is sampled far faster than a low-pass at `cutoff_hz` needs."""
    factor = int(log.rate_hz // (OVERSAMPLING * cutoff_hz))
    if factor < 2:
        return log
    safe = 0.4 * log.rate_hz / factor
    channels = {
        key: decimate(lowpass(x, safe, log.rate_hz) if key.startswith(("q_", "tau_")) else x, factor)
        for key, x in log.channels.items()
    }
    return replace(log, t=decimate(log.t, factor), channels=channels)


def smooth_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] that keeps of positions what stands above the encoder's noise, for making columns.

    Noise in the columns is noise in the residual, times a mass: a cause whose column has the same noise, or lacks it where
    the baseline has it, would be found in it.
    """
    edges = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz).signal_edge_hz.max() for log in logs]
    return SMOOTH_FACTOR * float(max(edges))


def smooth_cutoffs(robot: Robot, train: Sequence[Log], held: Sequence[Log]) -> tuple[float, ...]:
    """Return that low-pass [Hz] of each log: one for all that trains, at least as wide for what is held out.

    A held-out log may move more sharply than those trained on; cut like them, it would lose acceleration that the robot had.
    """
    shared = smooth_cutoff(robot, train)
    return (*[shared] * len(train), *[max(shared, smooth_cutoff(robot, [log])) for log in held])


def clear_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] of the forces that springs carry.

    A spring's force on the load is the fourth derivative of a position: above this, its column would be encoder noise, and the
    residual, which holds the same noise times a mass, would speak against any spring.
    """
    bands = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz) for log in logs]
    return float(max(max(band.clear_edge_hz.max(), band.edge_hz.max()) for band in bands))


def compute_border_gap_s(cutoff_hz: float, rate_hz: float) -> float:
    """Return the time [s] on both sides of a border in which a low-pass at `cutoff_hz` still remembers the other side."""
    return 0.5 * compute_edge_samples(cutoff_hz, rate_hz) / rate_hz
