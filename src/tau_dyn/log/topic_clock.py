"""A signal of one clock on another topic's clock, where that is honest, else a sentence why not.

Interpolation is the cubic spline of `resample.py`; its error falls with the fourth power of the step, so predicting every second
sample from those between tells it: what that misses is about sixteen times the error at the full rate. A signal whose every
second sample cannot be told from its neighbours changes too fast for its own clock; no interpolation gives what lies between.
Gaps are not bridged, and nothing is extrapolated. Reference: de Boor 2001 (error of the cubic spline).
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.exceptions import InputError
from tau_dyn.log.resample import MIN_GAP_STEPS

MAX_INTERPOLATION_ERROR = 0.5
"""Share of a signal's spread that its neighbours may miss of it at twice the step."""

MIN_CLOCK_SAMPLES = 10  # fewer give no rate


def resample_to_clock(where: str, t: np.ndarray, x: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, str]:
    """Return a signal at other times.

    Args:
        where: The file and column, to open a sentence.
        t: Its own times (N,) [s], increasing.
        x: Its samples (N,), finite.
        wanted: Times (M,) [s] within its first and last.

    Returns:
        The samples (M,), and a sentence about how they were made; empty where every time wanted is one of its own.

    Raises:
        InputError: It has gaps there, or changes too fast for its own clock.
    """
    at = np.minimum(np.searchsorted(t, wanted), t.size - 1)
    if np.array_equal(t[at], wanted):
        return x[at], ""
    if t.size < MIN_CLOCK_SAMPLES:
        raise InputError(
            "too_little_data", f"{where} has {t.size} samples, too few to be put on another topic's clock."
        )
    step = float(np.median(np.diff(t)))
    inside = (t >= wanted[0] - step) & (t <= wanted[-1] + step)
    t, x = t[inside], x[inside]
    if t.size < MIN_CLOCK_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{where} has {t.size} samples during the log, too few to be put on another topic's clock.",
        )
    steps = np.diff(t)
    widest = int(np.argmax(steps))
    if steps[widest] > MIN_GAP_STEPS * step:
        raise InputError(
            "time_stamps",
            f"{where} has a gap of {steps[widest]:.3g} s at t = {t[widest]:.4g} s (its step is {step:.3g} s), which is not "
            "bridged; cut the log there.",
        )
    share = estimate_interpolation_error(t, x)
    if share > MAX_INTERPOLATION_ERROR:
        raise InputError(
            "time_stamps",
            f"{where} cannot be put on another topic's clock: its samples ({1 / step:.4g} Hz) cannot be told from their "
            "neighbours, so neither can what lies between them; record both in one message, or faster.",
        )
    error = 100 * share / 16
    return CubicSpline(t, x)(wanted), f"interpolated from {1 / step:.4g} Hz, error about {max(error, 0.01):.2g} %"


def estimate_interpolation_error(t: np.ndarray, x: np.ndarray) -> float:
    """Return what every second sample differs from a spline through the others, as a share of the signal's spread."""
    spread = float(np.std(x))
    if spread <= 1e-12 * max(1.0, float(np.max(np.abs(x)))):
        return 0.0
    missed = (CubicSpline(t[::2], x[::2])(t[1::2]) - x[1::2])[1:-1]
    return float(np.sqrt(np.mean(missed**2))) / spread
