"""From measured positions to velocities, without shifting anything in time: filters on arrays (N, ...) along axis 0.

The low-pass is a Butterworth filter run forwards and backwards, so its power response is |H|^4 and its phase is zero:
`|H(f)|^2 = 1 / (1 + (tan(pi f dt) / tan(pi f_c dt))^(2 order))`, half the amplitude at `cutoff_hz`. Whatever multiplies
forces in a fit has to pass the same filter as the forces; filtering `W` and `tau` differently biases it. Derivatives
are central differences, with the gain `sin(w dt) / (w dt)`, 2.3 % short at 60 Hz and 1 kHz. Reference: Gautier,
Vandanjon & Presse 1994. Clocks live in `resample.py`.
"""

from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from tau_dyn.exceptions import InputError

TRANSIENT = 0.01
"""Share of a start-up transient that may be left after `compute_edge_samples`."""

_FLOOR = 1e-30
"""Constant put under a signal while it is filtered, in parts of its largest value, far below rounding: where a signal is zero for
long, the filter would fade into denormal numbers, with which processors are twenty times slower."""


def lowpass(x: ArrayLike, cutoff_hz: float, rate_hz: float, order: int = 4) -> NDArray[np.float64]:
    """Low-pass a signal with zero phase.

    The ends are continued point-symmetrically, which keeps slopes but not curvature: discard `compute_edge_samples` there.

    Args:
        x: Samples (N, ...), evenly spaced.
        cutoff_hz: Frequency at which half the amplitude passes [Hz] (each of the two runs lets 71 % pass).
        rate_hz: Sampling rate [Hz].
        order: Order of one run.

    Returns:
        Filtered samples (N, ...), in the unit of `x`.

    Raises:
        InputError: The cutoff is not below half the sampling rate, or the log is shorter than the filter's transient.
    """
    x = np.asarray(x, dtype=np.float64)
    if not 0.0 < cutoff_hz < rate_hz / 2:
        raise InputError(
            "invalid_value",
            f"cutoff {cutoff_hz:g} Hz has to be above 0 and below {rate_hz / 2:g} Hz, half the sampling rate.",
        )
    pad = compute_edge_samples(cutoff_hz, rate_hz, order)
    if len(x) <= pad:
        raise InputError(
            "invalid_value",
            f"{len(x)} samples at {rate_hz:g} Hz are too few for a low-pass of {cutoff_hz:g} Hz; give more than {pad}.",
        )
    sections = _sections(order, cutoff_hz, rate_hz)
    floor = _FLOOR * float(np.max(np.abs(x), initial=0.0))
    return np.asarray(signal.sosfiltfilt(sections, x + floor, axis=0, padlen=min(2 * pad, len(x) - 1))) - floor


@lru_cache(maxsize=64)
def _sections(order: int, cutoff_hz: float, rate_hz: float) -> NDArray[np.float64]:
    """Return the filter's second-order sections; designing them takes as long as filtering a short log."""
    return np.asarray(signal.butter(order, cutoff_hz, fs=rate_hz, output="sos"))


def compute_attenuation(f: NDArray[np.float64], cutoff_hz: float, order: int = 4) -> NDArray[np.float64]:
    """Return how many times smaller `lowpass` makes sines of frequencies f (...) [Hz], far below half the sampling rate."""
    return 1 + (f / cutoff_hz) ** (2 * order)


def compute_edge_samples(cutoff_hz: float, rate_hz: float, order: int = 4) -> int:
    """Return how many samples at each end of a log the low-pass of `lowpass` disturbs.

    After them 1 % of a transient is left, by the filter's slowest pole, of real part `-2 pi f_c sin(pi / (2 order))`.
    """
    decay = 2 * np.pi * cutoff_hz * np.sin(np.pi / (2 * order))
    return int(np.ceil(-np.log(TRANSIENT) / decay * rate_hz))


def differentiate(x: ArrayLike, dt: float, accuracy: int = 2) -> NDArray[np.float64]:
    """Differentiate by central differences, keeping all N samples.

    Args:
        x: Samples (N, ...), evenly spaced.
        dt: Time between samples [s].
        accuracy: Order of the error in `dt`: 2, or 4 where the motion reaches above 2 % of the sampling rate.

    Returns:
        Derivative (N, ...) in the unit of `x` per second. The first and last samples (two of each with `accuracy=4`)
        are of second order too, but one-sided or shorter, and noisier.

    Raises:
        InputError: There are too few samples, or the accuracy is neither 2 nor 4.
    """
    x = np.asarray(x, dtype=np.float64)
    if accuracy not in (2, 4) or len(x) < accuracy + 1:
        raise InputError(
            "invalid_value",
            f"{len(x)} samples cannot be differentiated with accuracy {accuracy}; give 2 or 4 and more samples.",
        )
    derivative = cast(Any, np.gradient(x, dt, axis=0, edge_order=2))
    if accuracy == 4:
        derivative[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * dt)
    return np.asarray(derivative)


def decimate(x: ArrayLike, factor: int) -> NDArray[np.float64]:
    """Keep every `factor`-th sample of (N, ...), starting with the first; low-pass it below half the new rate first."""
    if factor < 1:
        raise InputError("invalid_value", f"decimation by {factor} makes no sense; give a whole number from 1.")
    return np.asarray(x, dtype=np.float64)[::factor]


def find_reversals(v: ArrayLike, threshold: float = 0.0) -> NDArray[np.intp]:
    """Return the samples at which a velocity (N,) first exceeds `threshold` with the other sign."""
    v = np.asarray(v, dtype=np.float64)
    moving = np.flatnonzero(np.abs(v) > threshold)
    return moving[1:][np.diff(np.sign(v[moving])) != 0]
