"""Which gain, shift and cutoff: those that leave least of the error, among those that let no frequency grow.

At each frequency a trial multiplies the error by `Q (1 - L G)`. G is known with a standard error s, so the mean square of that
factor is

    m = Q^2 (|1 - L G|^2 + |L|^2 s^2)

A law is admitted where m does not exceed 1 at any frequency. Of these the one is taken that leaves least after a few trials:
what is not yet learnt, what Q forgets, and what does not repeat and is learnt all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.control.iterative.filters import ZeroPhase, design_low_pass
from tau_dyn.control.iterative.trial_response import TrialResponse

CUTOFFS_HZ = (40.0, 30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0)
"""Cutoffs that are tried [Hz]; the thesis learns up to 10."""

GAINS = (0.9, 0.7, 0.5, 0.35, 0.25, 0.15)
"""Gains that are tried; the thesis takes 0.9."""

_AHEAD = 3  # trials after which the error counts
_MORE_SHIFT = 8  # samples beyond delay and time constant that are tried
_MAX_SHIFTS = 40  # that are tried
_STAY_BELOW = 1.0  # mean square of the growth


@dataclass(frozen=True)
class LawChoice:
    """One drive's law, and what it is expected to do.

    Attributes:
        gain: Of L.
        shift: Of L [samples].
        cutoff_hz: Of Q [Hz].
        worst: Largest root mean square of the growth at any frequency.
        floor: RMS of what stays after many trials [m or rad].
    """

    gain: float
    shift: int
    cutoff_hz: float
    worst: float
    floor: float


def choose_law(
    response: TrialResponse,
    error: np.ndarray,
    command: np.ndarray,
    *,
    gains: Sequence[float] = GAINS,
    shifts: Sequence[int] | None = None,
    cutoffs: Sequence[float] = CUTOFFS_HZ,
    any_growth: bool = False,
) -> LawChoice | None:
    """Return the best law that is admitted, or None.

    Args:
        response: From the trials.
        error: Of the trial that learning goes on from (N,) [m or rad].
        command: What was added to its reference (N,).
        gains: Tried.
        shifts: Tried [samples]; by default around delay and time constant.
        cutoffs: Tried [Hz].
        any_growth: Without an admitted law, return the one with the least growth: it is asked for, and the caller judges it.
    """
    E = response.transform(error)
    start = E + response.mean * response.transform(command)
    tried = list_shifts(response) if shifts is None else np.asarray(shifts)
    best: tuple[float, LawChoice] | None = None
    least: LawChoice | None = None
    for cutoff in cutoffs:
        if cutoff >= 0.4 / response.dt:
            continue
        Q = design_low_pass(cutoff, response.dt).response(response.frequency)
        for gain in gains:
            left, k, worst, floor = _judge(response, E, start, Q, gain, tried)
            law = LawChoice(gain, int(tried[k]), cutoff, worst, floor)
            if np.isfinite(left) and (best is None or left < best[0]):
                best = left, law
            if least is None or worst < least.worst:
                least = law
    if best is not None:
        return best[1]
    return least if any_growth else None


def list_shifts(response: TrialResponse) -> np.ndarray:
    """Return shifts from none to beyond delay and time constant [samples]."""
    longest = int(np.ceil((response.model.delay + response.model.time_constant) / response.dt)) + _MORE_SHIFT
    return np.unique(np.round(np.linspace(0, longest, min(longest + 1, _MAX_SHIFTS))).astype(int))


def compute_growth(
    response: TrialResponse, filtered: ZeroPhase, gain: float, shift: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error of the size of the growth (F,)."""
    Q = filtered.response(response.frequency)
    L = gain * np.exp(2j * np.pi * response.frequency * response.dt * shift)
    return Q * np.abs(1 - L * response.mean), Q * gain * response.deviation


def _judge(
    response: TrialResponse, E: np.ndarray, start: np.ndarray, Q: np.ndarray, gain: float, shifts: np.ndarray
) -> tuple[float, int, float, float]:
    """Return what the best admitted shift leaves, its index, its worst growth and its floor.

    Where no shift is admitted, infinity and the shift with the least growth.
    """
    lead = np.exp(2j * np.pi * np.outer(shifts, response.frequency) * response.dt)
    one = Q * (1 - gain * lead * response.mean)
    square = np.abs(one) ** 2 + (Q * gain * response.deviation) ** 2
    worst = square.max(axis=1)
    part = np.minimum(square, 1 - 1e-6)
    stays = np.abs((1 - Q) * start / np.maximum(np.abs(1 - one), 1e-3)) ** 2
    noise = response.noise * (1 + (Q * gain * np.abs(response.mean)) ** 2 / (1 - part))
    last = stays + noise
    left = np.where(worst <= _STAY_BELOW, np.sum(part**_AHEAD * np.abs(E) ** 2 + last, axis=1), np.inf)
    k = int(np.argmin(left)) if np.any(np.isfinite(left)) else int(np.argmin(worst))
    scale = 2 / (response.length * response.n)  # of a sum over positive frequencies, to a mean square over the trial
    return float(left[k]), k, float(np.sqrt(worst[k])), float(np.sqrt(scale * np.sum(last[k])))
