r"""Input shapers: a command convolved with a few impulses leaves a resonance at rest when it ends.

An impulse makes a mode of second order ring; later ones, of the right size and half a period on, make it stop. What is left of
the vibration, over that of a single impulse of the same sum (Singer & Seering 1990, (3)),

    V(w, z) = exp(-z w t_n) sqrt(C^2 + S^2),   C + j S = sum_i A_i exp((z w + j w_d) t_i),   w_d = w sqrt(1 - z^2).

With T half a damped period and K = exp(-z w T), so that x = exp(-s T) has the zero x = -1 / K on the mode:

    ZV    A ~ [1, K]            zero residual at the estimate
    ZVD   A ~ [1, 2 K, K^2]     also zero slope, so that errors of the frequency count squared
    EI    A ~ [1, 2 c K, K^2]   zeros on either side; the residual is V0 at the estimate, and below it over a wider band

EI places its zeros at the mode's decay and the frequencies (1 +- acos(c) / pi) w_d; V = V0 at the mode gives
c = (2 K^2 - V0 (1 + K^2)) / (2 K (K + V0)), which for K = 1 is the undamped shaper of Singhose, Seering & Singer 1994,
A = [(1 + V0) / 4, (1 - V0) / 2, (1 + V0) / 4]. Several modes take one shaper after the other. At a controller's step, impulses
between two samples are split between both, which keeps their sum and their mean time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from tau_dyn.control.vibration.resonance import Resonance
from tau_dyn.exceptions import InputError

SHAPERS = ("zv", "zvd", "ei")
TOLERATED_VIBRATION = 0.05  # V0 of EI: the share of vibration that is usual in the literature
GRID = 41  # values of the frequency and of the damping ratio at which the residual is looked at, ends included
MAX_TAPS = 100_000  # samples that a shaper may last


@dataclass(frozen=True, eq=False)
class Shaper:
    """Impulses that a command is convolved with.

    Attributes:
        times: When (n,) [s], from 0.
        amplitudes: How large (n,); their sum is 1.
    """

    times: np.ndarray
    amplitudes: np.ndarray

    @property
    def duration(self) -> float:
        """By how much a command becomes longer [s]."""
        return float(self.times[-1])

    def sampled(self, dt: float) -> Shaper:
        """Return the shaper at a sampling step: impulses at samples only.

        Args:
            dt: The controller's step [s].

        Raises:
            InputError: The step is not positive, or the shaper would last too many samples.
        """
        if not 0 < dt < 1e9 or self.duration / dt > MAX_TAPS:
            raise InputError(
                "invalid_value",
                f"a step of {dt:g} s does not suit a shaper of {self.duration:.4g} s; give the controller's",
            )
        place = self.times / dt
        first = np.floor(place + 1e-9).astype(int)
        later = np.clip(place - first, 0.0, 1.0)
        taps = np.zeros(first[-1] + 2)
        np.add.at(taps, first, self.amplitudes * (1 - later))
        np.add.at(taps, first + 1, self.amplitudes * later)
        kept = np.flatnonzero(taps)
        return Shaper(kept * dt, taps[kept])

    def find_worst_residual(self, mode: Resonance) -> float:
        """Return the largest residual vibration over the 95 % intervals of a mode's frequency and damping."""
        f = np.linspace(*mode.frequency_interval, GRID)
        z = np.linspace(*mode.damping_interval, GRID)
        return float(compute_residual_vibration(self, f[:, None], z[None, :]).max())


def compute_residual_vibration(
    shaper: Shaper, frequency_hz: float | np.ndarray, damping_ratio: float | np.ndarray
) -> np.ndarray:
    """Return the vibration that a shaper leaves of modes, over that of one impulse of its sum (Singer & Seering 1990).

    Args:
        shaper: The shaper.
        frequency_hz: Undamped frequencies (...) [Hz].
        damping_ratio: Damping ratios (...), below 1.
    """
    w, z = np.broadcast_arrays(2 * np.pi * np.asarray(frequency_hz, float), np.asarray(damping_ratio, float))
    pole = -z * w + 1j * w * np.sqrt(1 - z**2)
    left = np.exp(np.multiply.outer(shaper.duration - shaper.times, pole))  # each impulse's ringing at the last one
    return np.abs(np.tensordot(shaper.amplitudes, left, axes=1))


def design_shaper(kind: str, mode: Resonance, tolerated: float = TOLERATED_VIBRATION) -> Shaper:
    """Return a shaper for one mode.

    Args:
        kind: `zv`, `zvd` or `ei`.
        mode: The mode.
        tolerated: Residual vibration of `ei` at the mode, between 0 and 1.

    Raises:
        InputError: There is no such shaper, or the tolerated vibration is not between 0 and 1.
    """
    if kind not in SHAPERS:
        raise InputError("bad_option", f"there is no shaper '{kind}'; there are {', '.join(SHAPERS)}")
    if not 0 < tolerated < 1:
        raise InputError("invalid_value", f"a tolerated vibration lies between 0 and 1, not at {tolerated:g}")
    z = mode.damping_ratio
    half = 0.5 / (mode.frequency_hz * np.sqrt(1 - z**2))
    K = float(np.exp(-z * np.pi / np.sqrt(1 - z**2)))
    c = 1.0
    if kind == "ei":  # where damping alone leaves less than is tolerated, zeros lie a quarter of a turn away at most
        c = max(0.0, (2 * K**2 - tolerated * (1 + K**2)) / (2 * K * (K + tolerated)))
    A = np.array([1.0, K] if kind == "zv" else [1.0, 2 * c * K, K**2])
    return Shaper(half * np.arange(len(A)), A / A.sum())


def combine_shapers(shapers: Sequence[Shaper]) -> Shaper:
    """Return several shapers one after the other."""

    def both(one: Shaper, other: Shaper) -> Shaper:
        times = np.add.outer(one.times, other.times).ravel()
        order = np.argsort(times, kind="stable")
        return Shaper(times[order], np.multiply.outer(one.amplitudes, other.amplitudes).ravel()[order])

    return reduce(both, shapers)
