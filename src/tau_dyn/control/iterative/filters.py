"""Filters of iterative learning: zero-phase filters Q and time shifts L (thesis 7.10, 7.11).

A zero-phase filter is a causal filter followed by the same filter backwards, `Q = Qc' Qc` (thesis 7.11). Its magnitude is
`|Qc|^2`, so a Butterworth filter attenuates by 6 dB, not 3, at its cutoff. Both passes start at rest, which makes the filter
exactly the matrix of (7.11); signals of learning are zero at both ends anyway.

The learning filter `L = gain q^shift` (thesis 7.10) takes a later sample of the error times a gain. The shift compensates the
delay of the plant. Beyond the end the last error is held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Protocol, cast

import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import butter, sosfilt, sosfreqz

from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class ZeroPhase:
    """A filter run forwards and backwards.

    Attributes:
        sections: The causal filter as second-order sections (s, 6).
        dt: Sampling step [s].
    """

    sections: np.ndarray
    dt: float

    def __post_init__(self) -> None:
        """Refuse a filter that is not stable."""
        radius = max((np.abs(np.roots(s[3:])).max(initial=0.0) for s in self.sections), default=0.0)
        if not radius < 1:
            raise InputError(
                "unstable", f"the filter is unstable: it has a pole of magnitude {radius:.4g}; all must be below 1"
            )

    def apply(self, x: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) filtered along time."""
        once = np.asarray(sosfilt(self.sections, x, axis=0))
        return np.asarray(sosfilt(self.sections, once[::-1], axis=0))[::-1]

    def matrix(self, n: int) -> np.ndarray:
        """Return `Qc' Qc` (n, n), thesis (7.11)."""
        impulse = np.eye(1, n)[0]
        causal = toeplitz(np.asarray(sosfilt(self.sections, impulse)), np.zeros(n))
        return causal.T @ causal

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the real, positive response (F,) at frequencies (F,) [Hz]."""
        _, once = sosfreqz(self.sections, worN=2 * np.pi * np.asarray(frequency, float) * self.dt)
        return np.abs(once) ** 2

    def times(self, other: ZeroPhase) -> ZeroPhase:
        """Return both filters one after the other.

        Raises:
            InputError: They are made for different sampling steps.
        """
        if abs(self.dt - other.dt) > 1e-9 * self.dt:
            raise InputError(
                "mismatch", f"filters for steps of {1000 * self.dt:g} and {1000 * other.dt:g} ms cannot be joined"
            )
        return ZeroPhase(np.vstack([self.sections, other.sections]), self.dt)


def design_low_pass(cutoff_hz: float, dt: float, order: int = 2) -> ZeroPhase:
    """Return a Butterworth low-pass, in both directions.

    Raises:
        InputError: The cutoff is not between zero and half the sampling rate.
    """
    return ZeroPhase(_butter(order, cutoff_hz, "lowpass", dt), dt)


def design_band_stop(low_hz: float, high_hz: float, dt: float, order: int = 1) -> ZeroPhase:
    """Return a Butterworth band-stop, in both directions: learning stops in the middle of the band."""
    if not low_hz < high_hz:
        raise InputError(
            "invalid_value", f"a band goes from a lower to a higher frequency, not from {low_hz:g} to {high_hz:g} Hz"
        )
    return ZeroPhase(_butter(order, (low_hz, high_hz), "bandstop", dt), dt)


def build_notch(centre_hz: float, width_hz: float, floor: float, dt: float) -> ZeroPhase:
    r"""Return a filter that takes the magnitude down to `floor` at one frequency and leaves it 1 far from it.

    Each pass is `(s^2 + g w s + w0^2) / (s^2 + w s + w0^2)` with `g = sqrt(floor)`, `w` the width [rad/s], mapped by the
    bilinear transform that keeps the centre. Learning is reduced there, but not to zero.
    """
    if not (0 < floor <= 1 and width_hz > 0):
        raise InputError(
            "invalid_value", f"a dip has a positive width and a floor between 0 and 1, not {width_hz:g} Hz, {floor:g}"
        )
    _inside(centre_hz, dt)
    t, w = np.tan(np.pi * centre_hz * dt), width_hz / centre_hz
    damped = [t * w * np.sqrt(floor), t * w]
    b, a = ([1 + d + t**2, 2 * (t**2 - 1), 1 - d + t**2] for d in damped)
    return ZeroPhase(np.array([[*b, *a]]) / a[0], dt)


def chain_filters(filters: Sequence[ZeroPhase]) -> ZeroPhase:
    """Return several filters one after the other."""
    return reduce(ZeroPhase.times, filters)


def _butter(order: int, cutoff: float | tuple[float, float], kind: str, dt: float) -> np.ndarray:
    for f in np.atleast_1d(cutoff):
        _inside(float(f), dt)
    return cast(np.ndarray, butter(order, cutoff, kind, fs=1 / dt, output="sos"))


def _inside(frequency: float, dt: float) -> None:
    if not 0 < frequency < 0.5 / dt:
        raise InputError(
            "invalid_value",
            f"a cutoff of {frequency:g} Hz does not fit to samples every {1000 * dt:g} ms; it takes 0 to {0.5 / dt:g} Hz",
        )


class LearningFilter(Protocol):
    """L, from a trial's error to the change of the correction."""

    @property
    def dt(self) -> float:
        """Sampling step [s]."""
        ...

    def apply(self, e: np.ndarray) -> np.ndarray:
        """Return errors (N, ...) through L."""
        ...

    def transposed(self, e: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) through the transposed matrix."""
        ...

    def matrix(self, n: int) -> np.ndarray:
        """Return (n, n)."""
        ...

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz]."""
        ...


@dataclass(frozen=True)
class TimeShift:
    """A gain and a shift forwards in time.

    Attributes:
        gain: Part of the error that one iteration removes if the plant follows without delay.
        samples: Whole samples.
        dt: Sampling step [s].
    """

    gain: float
    samples: int
    dt: float

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        if not np.isfinite(self.gain) or self.samples < 0 or not self.dt > 0:
            raise InputError(
                "invalid_value", "a learning filter has a finite gain, a shift of 0 samples or more and a positive step"
            )

    def apply(self, e: np.ndarray) -> np.ndarray:
        """Return errors (N, ...) shifted, the last one held."""
        return self.gain * e[self._places(len(e))]

    def transposed(self, e: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) through the transposed matrix."""
        out = np.zeros_like(e)
        np.add.at(out, self._places(len(e)), self.gain * e)
        return out

    def matrix(self, n: int) -> np.ndarray:
        """Return (n, n), thesis (7.10)."""
        return self.gain * np.eye(n)[self._places(n)]

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz], without the effects of both ends."""
        return self.gain * np.exp(2j * np.pi * np.asarray(frequency, float) * self.dt * self.samples)

    def _places(self, n: int) -> np.ndarray:
        return np.minimum(np.arange(n) + self.samples, n - 1)
