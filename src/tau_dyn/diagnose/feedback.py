r"""What a controller makes of encoder noise, seen where nothing else is to be seen.

A drive that closes its loop through a noisy encoder answers the noise with force: `tau = ... + sum_l H_l n(t - l dt)`. That
noise is in the columns as well, so force and columns agree about something that the robot never did, and a delay or a spring is
found in it. Above the motion's band the measured position is noise and the force is the answer to it, so `H` is fitted there, by
least squares on high-passed signals; how many lags there are, or none, is chosen by BIC. A few taps, as a discrete cascade
has them, are the same below that band. Reference: Ljung 1999, 13.4 (identification in closed loop).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.log import lowpass

LAGS = (1, 2, 3, 5)
"""Numbers of taps that are tried."""
_WIDEST = 0.35
"""Cutoff above which too little is left to fit to, as a share of the rate."""


def feedback_taps(q: np.ndarray, residual: np.ndarray, cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return the answer of forces to encoder noise `H` (taps, na, na) [N/m ..]; no taps where there is none.

    Args:
        q: Measured positions (N, na), as logged.
        residual: Measured forces less those of the model along the smooth motion (N, na).
        cutoff_hz: Up to here positions hold motion [Hz].
        rate_hz: Sampling rate [Hz].
    """
    n, na = q.shape
    none = np.zeros((0, na, na))
    if cutoff_hz > _WIDEST * rate_hz:
        return none
    noise, answer = (x - lowpass(x, cutoff_hz, rate_hz) for x in (q, residual))
    most = max(LAGS)
    answer = answer[most:]
    best, chosen = _bic(answer, 0), none
    for taps in LAGS:
        rows = np.concatenate([noise[most - lag : n - lag] for lag in range(taps)], axis=1)
        found = np.linalg.lstsq(rows, answer, rcond=None)[0]
        value = _bic(answer - rows @ found, taps * na)
        if value < best:
            best, chosen = value, found.reshape(taps, na, na)
    return chosen


def answered(taps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the forces (N, na) with which these taps answer encoder noise (N, na)."""
    force = np.zeros_like(noise)
    for lag, H in enumerate(taps):
        force[lag:] += noise[: len(noise) - lag] @ H
    return force


def _bic(e: np.ndarray, freedom: int) -> float:
    """Return the criterion of all outputs together, each with `freedom` coefficients."""
    power = np.maximum(np.mean(e**2, axis=0), 1e-300)
    return float(len(e) * np.sum(np.log(power)) + e.shape[1] * freedom * np.log(len(e)))
