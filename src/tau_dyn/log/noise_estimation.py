"""How noisy an encoder is, and what that makes of a velocity, from the log itself.

An encoder's noise and its quantisation while moving are white; a motion driven through a mass is not, and its spectrum
falls steeply. So the level is read where motion has died out, in the upper half of the band (a quarter to half of the
sampling rate):

1. fourth differences whiten the motion away (2 Hz at 1 kHz is reduced to 2.5e-8) and multiply white noise by |2 sin(w
   dt / 2)|^4;
2. the log is cut into windows, and those in which the joint stands still are left out, since a resting encoder hides
   its rounding;
3. in each window the level is the median over frequencies of the periodogram divided by that gain, which a few lines (a
   gear, a resonance) do not move; over windows it is the median again, which a few knocks do not move;
4. a level below that of uniform rounding, step / sqrt(12), is raised to it.

Then `sigma_v^2 = sigma^2 (2 dt) int |H|^4 (sin(w dt) / dt)^2 df`, with `|H|^4` the zero-phase low-pass of
`filtering.py`. The estimate fails, to the high side, where real vibration fills the whole upper band, and to the low
side where the drive has already filtered q.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

WINDOW_SAMPLES = 128
"""Samples of one window: a spectral resolution of 1/128 of the sampling rate."""

_DIFFERENCES = 4  # order of differences, which remove a smooth motion


def estimate_quantisation_step(q: ArrayLike) -> NDArray[np.float64]:
    """Return the step (n,) or () of a rounded signal (N, n) or (N,), and 0 where values stand on no grid.

    The step is the smallest change between samples; it counts only if 99 % of all changes are whole multiples of it.
    """
    q = np.asarray(q, dtype=np.float64)
    steps = np.array([_step(column) for column in q.reshape(len(q), -1).T])
    return steps.reshape(q.shape[1:])


def estimate_encoder_noise(q: ArrayLike) -> NDArray[np.float64]:
    """Return the standard deviation (n,) or () of the white noise on positions (N, n) or (N,), in their unit."""
    q = np.asarray(q, dtype=np.float64)
    columns = q.reshape(len(q), -1).T
    floor = estimate_quantisation_step(q).reshape(-1) / np.sqrt(12)
    return np.maximum([_white_level(column) for column in columns], floor).reshape(q.shape[1:])


def compute_velocity_noise(q: ArrayLike, rate_hz: float, cutoff_hz: float, order: int = 4) -> NDArray[np.float64]:
    """Return how much encoder noise is left in a filtered and differentiated position.

    Args:
        q: Measured positions (N, n) or (N,) [m or rad], evenly spaced and not filtered.
        rate_hz: Sampling rate [Hz].
        cutoff_hz: Cutoff of the zero-phase low-pass before differentiation [Hz].
        order: Order of one of its runs.

    Returns:
        Standard deviation (n,) or () of the velocity [m/s or rad/s] that noise and quantisation alone cause.
    """
    return estimate_encoder_noise(q) * compute_noise_gain(rate_hz, cutoff_hz, order, derivatives=1)


def compute_noise_gain(rate_hz: float, cutoff_hz: float, order: int = 4, derivatives: int = 1) -> float:
    """Return what `lowpass` and central differences make of white noise of 1 [1/s^derivatives]."""
    half_turns = (np.arange(4096) + 0.5) / 4096 * np.pi / 2  # pi f dt, from 0 to half the sampling rate
    with np.errstate(over="ignore"):
        passed = 1.0 / (1.0 + (np.tan(half_turns) / np.tan(np.pi * cutoff_hz / rate_hz)) ** (2 * order))
    slope = np.sin(2 * half_turns) * rate_hz
    return float(np.sqrt(np.mean(passed**2 * slope ** (2 * derivatives))))


def _step(q: NDArray[np.float64]) -> float:
    changes = np.abs(np.diff(q))
    changes = changes[changes > 1e-12 * max(float(np.abs(q).max()), 1e-300)]
    if changes.size == 0:
        return 0.0
    step = float(changes.min())
    multiples = changes / step
    on_grid = np.abs(multiples - np.round(multiples)) <= 0.05
    return step if np.mean(on_grid) >= 0.99 and np.median(multiples) < 1e4 else 0.0


def _white_level(q: NDArray[np.float64]) -> float:
    """Return the standard deviation of the white part of one signal (N,)."""
    width = min(WINDOW_SAMPLES, len(q) - _DIFFERENCES)
    if width < 16:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(np.diff(q, n=_DIFFERENCES), width)[:: width // 2]
    moving = np.any(windows != 0.0, axis=1) & (np.mean(windows != 0.0, axis=1) > 0.5)
    windows = windows[moving] if np.any(moving) else windows
    taper = np.hanning(width)
    power = np.abs(np.fft.rfft(windows * taper, axis=1)) ** 2 / np.sum(taper**2)
    omega = 2 * np.pi * np.fft.rfftfreq(width)
    band = (omega >= np.pi / 2) & (omega < 0.98 * np.pi)
    level = np.median(power[:, band] / (2 * np.sin(omega[band] / 2)) ** (2 * _DIFFERENCES), axis=1) / np.log(2)
    return float(np.sqrt(np.median(level)))
