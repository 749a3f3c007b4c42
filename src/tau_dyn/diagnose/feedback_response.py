r"""What a controller makes of encoder noise, seen where nothing else is to be seen.

A drive that closes its loop through a noisy encoder answers the noise with force: `tau = ... + sum_l H_l n(t - l dt)`. That
noise is in the columns as well, so force and columns agree about something that the robot never did, and a delay or a spring is
found in it. Far above the motion's band the measured position is noise and the force is the answer to it, so `H` is fitted
there, by least squares on high-passed signals; how many lags there are, or none, is chosen by BIC. A few taps, as a discrete
cascade has them, are the same below that band, at the log's own rate: thinned, the same cascade has an answer of many taps, of
which the low frequencies, where motion is, show nothing.

The forces move the robot, too: a loop follows slow noise, so that less of it is read. This is not computed. A log may hold
every fourth of the samples that the drive saw; what it read in between is aliased into the log, and nothing follows that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.log import Log, lowpass

REACHES = (0, 1, 2, 4)
"""How many samples before and after the noise its answers are looked for in."""
_MIN_CUTOFF_SHARE = 0.25
"""Cutoff that is used at least, as a share of the rate: above it motion through a mass has died out (`log/filtering.py`). Just
above the motion's band a tenth of the noise still is motion, which answers by its mass, and many taps followed that."""
_MAX_CUTOFF_SHARE = 0.35
"""Cutoff above which too little is left to fit to, as a share of the rate; motion that reaches beyond is small there."""


def estimate_feedback_taps(log: Log, joints: Sequence[str], cutoff_hz: float) -> np.ndarray:
    """Return the answer of forces to encoder noise `H` (2 L + 1, na, na) [N/m ..] at lags -L to L; empty where there is none.

    Args:
        log: Positions and forces at the rate at which they were logged.
        joints: The actuated joints.
        cutoff_hz: Up to here positions hold motion [Hz].
    """
    q, rate_hz = log.joint("q", joints), log.rate_hz
    na, above = q.shape[1], min(max(cutoff_hz, _MIN_CUTOFF_SHARE * rate_hz), _MAX_CUTOFF_SHARE * rate_hz)
    noise, answer = (x - lowpass(x, above, rate_hz) for x in (q, log.joint("tau", joints)))
    inner = slice(max(REACHES), -max(REACHES))
    answer = answer[inner]
    free = len(answer) * (1 - 2 * above / rate_hz)  # so many samples are free of each other in the band that is left
    best, chosen = _bic(answer, 0, free), np.zeros((0, na, na))
    for reach in REACHES:
        rows = np.concatenate([x[inner] for x in _lagged(noise, reach)], axis=1)
        found = np.linalg.lstsq(rows, answer, rcond=None)[0]
        value = _bic(answer - rows @ found, rows.shape[1], free)
        if value < best:
            best, chosen = value, found.reshape(-1, na, na)
    return chosen


def apply_feedback_taps(taps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the forces (N, na) with which these taps answer encoder noise (N, na)."""
    if not len(taps):
        return np.zeros_like(noise)
    return sum((x @ H for x, H in zip(_lagged(noise, len(taps) // 2), taps, strict=True)), np.zeros_like(noise))


def _lagged(noise: np.ndarray, reach: int) -> list[np.ndarray]:
    """Return the noise (N, na) at lags `-reach` to `reach`, zero beyond its ends."""
    padded = np.pad(noise, ((reach, reach), (0, 0)))
    return [padded[reach - lag : reach - lag + len(noise)] for lag in range(-reach, reach + 1)]


def _bic(e: np.ndarray, freedom: int, samples: float) -> float:
    """Return the criterion of all outputs together, each with `freedom` coefficients and so many free samples."""
    power = np.maximum(np.mean(e**2, axis=0), 1e-300)
    return float(samples * np.sum(np.log(power)) + e.shape[1] * freedom * np.log(samples))
