"""Learning of one drive: compare each trial with its prediction, then return the next correction or the reason to stop.

The prediction of a trial uses only earlier trials and the command of the trial. Outcomes outside the interval widen the next
interval. A trial above its interval changes the law: the response is estimated again with this trial, the gain is halved, and
learning continues from the best trial. After two such trials in a row without improvement, learning stops at the best trial's
correction.

Gain, shift and cutoff are those with the smallest remaining error, among those that amplify no frequency. At each frequency a
trial multiplies the error by `Q (1 - L G)`. G is known with a standard error s, so the mean square of that factor is

    m = Q^2 (|1 - L G|^2 + |L|^2 s^2)

A law is admitted if m does not exceed 1 at any frequency. The admitted law with the smallest error after a few trials is chosen.
This error has three parts: the part not yet learnt, the part that Q removes from the correction, and the non-repeating part that
is learnt nevertheless. With a model of the resonances (`resonant_drive`), the inverse of G is tried as L next to the shifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tau_dyn.control.iterative.filters import LearningFilter, TimeShift, ZeroPhase, design_low_pass
from tau_dyn.control.iterative.laws import LearningLaw
from tau_dyn.control.iterative.learned_outputs import Reference
from tau_dyn.control.iterative.resonant_drive import DriveModel, ResonantDrive, ResponseInverse
from tau_dyn.control.iterative.trial_loop import (
    Convergence,
    analyse_convergence,
    compute_frequency_condition,
)
from tau_dyn.control.iterative.trial_response import (
    Forecast,
    TrialResponse,
    choose_model,
    estimate_response,
    forecast_trial,
)

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
    """One drive's law and its expected performance.

    Attributes:
        gain: Gain of L.
        shift: Shift of L [samples]; None for the inverse of the response.
        cutoff_hz: Cutoff of Q [Hz].
        worst: Largest root mean square of the growth at any frequency.
        floor: RMS of the error that remains after many trials [m or rad].
    """

    gain: float
    shift: int | None
    cutoff_hz: float
    worst: float
    floor: float

    def build_filter(self, response: TrialResponse) -> LearningFilter:
        """Return L."""
        if self.shift is not None:
            return TimeShift(self.gain, self.shift, response.dt)
        inverse = self.gain * invert_response(response)
        return ResponseInverse(np.concatenate([inverse[:1].real, inverse]), response.length, response.dt)


def invert_response(response: TrialResponse) -> np.ndarray:
    """Return the inverse (F,) with the smallest mean square of what it leaves, for a gain of 1."""
    return response.mean.conj() / np.maximum(np.abs(response.mean) ** 2 + response.deviation**2, 1e-300)


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
    """Return the best admitted law, or None.

    Args:
        response: Response estimated from the trials.
        error: Error of the trial from which learning continues (N,) [m or rad].
        command: Correction in that trial (N,).
        gains: Gains to try.
        shifts: Shifts to try [samples]; by default around delay and time constant.
        cutoffs: Cutoffs to try [Hz].
        any_growth: If no law is admitted, return the one with the least growth; the caller then judges it.
    """
    E = response.transform(error)
    inverse = invert_response(response)[None] if shifts is None and isinstance(response.model, ResonantDrive) else None
    start = E + response.mean * response.transform(command)
    tried = list_shifts(response) if shifts is None else np.asarray(shifts)
    lead = np.exp(2j * np.pi * np.outer(tried, response.frequency) * response.dt)
    best: tuple[float, LawChoice] | None = None
    least: LawChoice | None = None
    for cutoff in cutoffs:
        if cutoff >= 0.4 / response.dt:
            continue
        Q = design_low_pass(cutoff, response.dt).response(response.frequency)
        for gain in gains:
            for unit in (lead, *(() if inverse is None else (inverse,))):
                left, k, worst, floor = _judge(response, E, start, Q, gain * unit)
                law = LawChoice(gain, int(tried[k]) if unit is lead else None, cutoff, worst, floor)
                if np.isfinite(left) and (best is None or left < best[0]):
                    best = left, law
                if least is None or worst < least.worst:
                    least = law
    if best is not None:
        return best[1]
    return least if any_growth else None


def list_shifts(response: TrialResponse) -> np.ndarray:
    """Return shifts from zero to beyond delay and time constant [samples]."""
    longest = int(np.ceil((response.model.delay + response.model.time_constant) / response.dt)) + _MORE_SHIFT
    return np.unique(np.round(np.linspace(0, longest, min(longest + 1, _MAX_SHIFTS))).astype(int))


def compute_growth(
    response: TrialResponse, filtered: ZeroPhase, learning: LearningFilter
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error of the size of the growth (F,)."""
    Q, L = filtered.response(response.frequency), learning.response(response.frequency)
    return Q * np.abs(1 - L * response.mean), Q * np.abs(L) * response.deviation


def _judge(
    response: TrialResponse, E: np.ndarray, start: np.ndarray, Q: np.ndarray, L: np.ndarray
) -> tuple[float, int, float, float]:
    """Return the remaining error of the best admitted L of several (S, F), its index, its worst growth and its floor.

    If none is admitted, return infinity and the one with the least growth.
    """
    one = Q * (1 - L * response.mean)
    square = np.abs(one) ** 2 + (Q * np.abs(L) * response.deviation) ** 2
    worst = square.max(axis=1)
    part = np.minimum(square, 1 - 1e-6)
    stays = np.abs((1 - Q) * start / np.maximum(np.abs(1 - one), 1e-3)) ** 2
    noise = response.noise * (1 + (Q * np.abs(L * response.mean)) ** 2 / (1 - part))
    last = stays + noise
    left = np.where(worst <= _STAY_BELOW, np.sum(part**_AHEAD * np.abs(E) ** 2 + last, axis=1), np.inf)
    k = int(np.argmin(left)) if np.any(np.isfinite(left)) else int(np.argmin(worst))
    scale = 2 / (response.length * response.n)  # of a sum over positive frequencies, to a mean square over the trial
    return float(left[k]), k, float(np.sqrt(worst[k])), float(np.sqrt(scale * np.sum(last[k])))


Action = Literal["learn", "change", "floor", "stop"]

_WORSE = 1.05  # of the best trial's error: beyond it, learning continues from the best one
_GAINED = 0.95  # of the error: a median above it is no improvement
_MISSES = 2  # in a row above the interval, until learning stops
_TRIALS_FOR_A_FLOOR = 3  # fewer do not separate noise from a response that depends on the change
_PRIOR_SCORES = 3.0  # trials as spread as predicted that the interval's width starts from


@dataclass(frozen=True, eq=False)
class JointLearning:
    """Learning state of one drive.

    Attributes:
        response: Response estimated from all trials.
        given_rms: RMS error of the given actuator on the first trial [m or rad]; None without a given actuator.
        fitted_rms: RMS error of the actuator fitted to the first trial.
        forecasts: Prediction of each trial; None for the first.
        outcomes: RMS errors of the trials where learning acts fully (K,) [m or rad].
        base: Index of the trial from which the next correction starts.
        law: The law; None if no law is admitted.
        filtered: Q of the law.
        learning: L of the law.
        correction: The next correction (N,).
        forecast: Prediction of the next trial.
        convergence: Convergence of the law on the mean response; for a chosen law, by the frequency condition.
        action: `learn`; `change`: the last trial missed its prediction, so the law changes; `floor`: the remaining error is
            not expected to fall; `stop`.
        reason: Sentence; empty for `learn`.
    """

    response: TrialResponse
    given_rms: float | None
    fitted_rms: float
    forecasts: tuple[Forecast | None, ...]
    outcomes: np.ndarray
    base: int
    law: LawChoice | None
    filtered: ZeroPhase | None
    learning: LearningFilter | None
    correction: np.ndarray
    forecast: Forecast
    convergence: Convergence | None
    action: Action
    reason: str

    def growth(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard error of an error's growth in a trial (F,); one and zero without a law."""
        if self.learning is None or self.filtered is None:
            return np.ones(len(self.response.frequency)), np.zeros(len(self.response.frequency))
        return compute_growth(self.response, self.filtered, self.learning)

    @property
    def largest_growth(self) -> tuple[float, float, float]:
        """Largest growth of any frequency in a trial: its mean, and the ends of its 95 % interval."""
        mean, stderr = self.growth()
        k = int(np.argmax(mean + 1.96 * stderr))
        return float(mean[k]), float(max(mean[k] - 1.96 * stderr[k], 0.0)), float(mean[k] + 1.96 * stderr[k])


@dataclass(frozen=True)
class LawOptions:
    """Requested values of a law; those that are None are chosen."""

    gain: float | None = None
    shift: int | None = None
    cutoff_hz: float | None = None

    @property
    def given(self) -> bool:
        """Whether any value is requested."""
        return any(x is not None for x in (self.gain, self.shift, self.cutoff_hz))


def learn_joint(
    motion: Reference,
    sent: Sequence[np.ndarray],
    position: Sequence[np.ndarray],
    given: DriveModel | None,
    options: LawOptions = LawOptions(),
) -> JointLearning:
    """Return the next correction of one drive.

    Args:
        motion: Motion of the drive, with `q` (N, 1).
        sent: Commands of the trials, each (N,) [m or rad], in their order.
        position: Measured positions, in the same form.
        given: A model of the drive; None takes one from the first trial.
        options: Options of the law.

    Raises:
        CannotAnswer: The command never moves, or the position does not follow it.
    """
    reference = motion.q[:, 0]
    errors = [reference - y for y in position]
    outcomes = np.array([compute_rms(e, motion.full) for e in errors])
    model, given_rms, fitted_rms = choose_model(given, sent[0], position[0], motion.dt)
    forecasts, width = _forecast_past(model, motion, sent, position, outcomes)
    response = estimate_response(model, sent, position, motion.dt, motion.full)
    base = len(sent) - 1 if outcomes[-1] <= _WORSE * outcomes.min() else int(np.argmin(outcomes))
    misses = _count_misses(forecasts, outcomes)
    before = sent[base] - reference
    law = _choose(response, errors[base], before, options, misses)
    correction, filtered, learning = before, None, None
    if law is not None:
        filtered, learning = design_low_pass(law.cutoff_hz, motion.dt), law.build_filter(response)
        asked = before + learning.apply(errors[base])
        correction = motion.weights() * filtered.apply(asked)
    forecast = forecast_trial(response, errors[base], correction - before, motion.full).widened(*width)
    action, reason = _decide(law, forecast, outcomes, base, misses, options)
    if action in ("floor", "stop") and np.any(correction != before):
        correction = before
        forecast = forecast_trial(response, errors[base], 0.0 * before, motion.full).widened(*width)
    convergence = None
    if learning is not None and filtered is not None:
        whole = LearningLaw(response.side(), (filtered,), learning)
        convergence = analyse_convergence(whole, motion) if options.given else _bound_convergence(whole)
    return JointLearning(
        response, given_rms, fitted_rms, forecasts, outcomes, base, law, filtered, learning, correction, forecast,
        convergence, action, reason,
    )  # fmt: skip


def _bound_convergence(law: LearningLaw) -> Convergence:
    """Return the convergence by the frequency condition alone: the largest growth is the singular value of an endless trial."""
    picture = compute_frequency_condition(law)
    assert picture is not None  # a law of filters has one
    return Convergence((picture.worst[1],), picture.worst[1], picture)


def compute_rms(x: np.ndarray, full: slice) -> float:
    """Return the root mean square of a signal where learning acts fully."""
    return float(np.sqrt(np.mean(x[full] ** 2)))


def _forecast_past(
    model: DriveModel,
    motion: Reference,
    sent: Sequence[np.ndarray],
    position: Sequence[np.ndarray],
    outcomes: np.ndarray,
) -> tuple[tuple[Forecast | None, ...], tuple[float, float]]:
    """Return the prediction of each trial from those before it, and the widths that their misses give the next interval."""
    found: list[Forecast | None] = [None]
    scores: list[float] = []
    for k in range(1, len(sent)):
        response = estimate_response(model, sent[:k], position[:k], motion.dt, motion.full)
        nearest = min(range(k), key=lambda j: (float(np.sum((sent[k] - sent[j]) ** 2)), -j))
        error = motion.q[:, 0] - position[nearest]
        plain = forecast_trial(response, error, sent[k] - sent[nearest], motion.full)
        found.append(plain.widened(*_compute_widths(scores)))
        scores.append(plain.score(float(outcomes[k])))
    return tuple(found), _compute_widths(scores)


def _compute_widths(scores: Sequence[float]) -> tuple[float, float]:
    """Return the factors of an interval's lower and upper part after scores in standard deviations; never below 1."""
    z = np.asarray(scores)
    squares = (float(np.sum(np.minimum(z, 0) ** 2)), float(np.sum(np.maximum(z, 0) ** 2)))
    below, above = (max(1.0, float(np.sqrt((_PRIOR_SCORES + 2 * s) / (_PRIOR_SCORES + len(z))))) for s in squares)
    return below, above


def _count_misses(forecasts: Sequence[Forecast | None], outcomes: np.ndarray) -> int:
    """Return how many of the last trials in a row ended above their interval, or above the first trial's error."""
    count = 0
    for forecast, rms in zip(reversed(forecasts), outcomes[::-1], strict=True):
        if forecast is None or rms <= min(forecast.high, outcomes[0]):
            break
        count += 1
    return count


def _choose(
    response: TrialResponse, error: np.ndarray, command: np.ndarray, options: LawOptions, misses: int
) -> LawChoice | None:
    """Return the law: requested values are kept, the others are chosen, with the gain halved for each miss."""
    gains = (options.gain,) if options.gain is not None else tuple(g * 0.5**misses for g in GAINS)
    shifts = None if options.shift is None else (options.shift,)
    cutoffs = CUTOFFS_HZ if options.cutoff_hz is None else (options.cutoff_hz,)
    return choose_law(response, error, command, gains=gains, shifts=shifts, cutoffs=cutoffs, any_growth=options.given)


def _decide(
    law: LawChoice | None, forecast: Forecast, outcomes: np.ndarray, base: int, misses: int, options: LawOptions
) -> tuple[Action, str]:
    """Return the next action and its reason."""
    best = f"trial {base + 1}"
    if law is None:
        return "stop", (
            "no law is known to let no frequency grow: the trials do not show a response that a correction can use; "
            f"the correction of {best} stays"
        )
    if misses >= _MISSES and base < len(outcomes) - misses:
        return "stop", (
            f"the last {misses} trials ended above their predicted intervals or the first error, and no trial is better "
            f"than {best}; "
            "its correction stays"
        )
    if options.given:
        return "learn", ""
    if misses:
        return "change", (
            f"trial {len(outcomes)} ended above its prediction or the first error; the law is chosen again with half the gain"
            + ("" if base == len(outcomes) - 1 else f", from {best} on")
        )
    if len(outcomes) >= _TRIALS_FOR_A_FLOOR and forecast.rms > _GAINED * outcomes[base]:
        return "floor", f"a further change is not expected to lower the error of {best}; its correction stays"
    return "learn", ""
