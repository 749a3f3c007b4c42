"""Filters and masks of logs, chosen from the data, and the samples and pieces that remain.

One rule for every log, no constant in physical units:

1. the motion band f_b of each axis against its encoder's noise (`log/filtering.py`), of the axis with the widest band;
2. forces and columns are low-passed at f_w = min(5 f_b, f_noise, 0.16 f_s): wide enough to keep the friction's edges, not so wide
   that acceleration noise, which is in the columns, exceeds 1e-4 of the acceleration's power and biases the fit;
3. positions are low-passed at f_q = min(8 f_w, 0.4 f_s): its transient at a reversal is much shorter than that of f_w;
4. decimation to 2.5 f_w, just above twice the filter's cutoff;
5. an axis' sign is unsure when its speed is below ten times its own velocity noise (encoder noise through filter and
   differentiation) or reverses; samples within two periods of f_q, the first filter's memory, are gated out there. After one
   period its ringing is still 4 % of the step in friction, which biased Coulomb friction by two standard errors in 100 s of L1
   at 1 kHz (`experiments/recovery.py`). Positions that were smoothed before they were logged show no noise; their
   axis counts as at rest below 2 % of its own fast speed.

`experiments/preparation_sensitivity.py` shows the sensitivity of the estimates to each factor on EMPS and TX40. It is small for
the first four. The gate's width changes TX40's Coulomb friction by up to 4 %, as its friction deviates from the law at low speed.

A zero-phase low-pass disturbs both ends of a piece, so a piece gives rows only if it is longer than both ends together; others
are left out and reported. The information of the rest is counted in independent values: a motion of band f_b gives `2 f_b T`
independent values in a time T (Nyquist), at any sampling rate.

A gate is 1 for a sample that may be used and 0 for others, with ramps between, two periods of the position filter's cutoff
long: a sharp edge would fold the acceleration's noise, large above the band of the filter that follows, into it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.ndimage import convolve1d, minimum_filter1d
from scipy.special import erf

from tau_dyn.effects import Effect, Motion
from tau_dyn.estimate import ROUNDING, Preparation, Regression
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.legged import ContactElimination, eliminate_contacts, find_contacts, find_usual_flight
from tau_dyn.log import (
    FORCE_BAND_FACTOR,
    MIN_SEGMENT_SAMPLES,
    ROOM_TEMPERATURE,
    SPEED_NOISE_FACTOR,
    EvenSegment,
    InMemorySegment,
    Log,
    MotionBand,
    Recording,
    check_jumps,
    choose_force_cutoff,
    compute_edge_samples,
    compute_rest_speed,
    count_short_segments,
    examine_clock,
    find_motion_band,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import COMPUTED, Model
from tau_dyn.results import count
from tau_dyn.robot import Robot

BAND_FACTOR = FORCE_BAND_FACTOR  # low-pass of forces over the motion's band edge
POSITION_FACTOR = 8.0  # low-pass of positions over that of forces
RATE_FACTOR = 2.5  # rate kept after decimation over the low-pass; 2 is the sampling theorem
NOISE_FACTOR = SPEED_NOISE_FACTOR  # speed in standard deviations of its noise, from which its sign is known
MIN_RATE_HZ = 5.0
"""A log sampled more slowly shows no dynamics; mostly its clock is not in seconds."""

MEMORY = 2.0
"""Half-width of the first filter's response to a step, in periods of its cutoff; 0.3 % of the step is left after it."""


def refuse_slow_clocks(logs: Sequence[Log]) -> None:
    """Refuse logs whose clock is probably not in seconds.

    Raises:
        InputError: A log has fewer than `MIN_RATE_HZ` samples a second.
    """
    slow = min(logs, key=lambda log: log.rate_hz)
    if slow.rate_hz < MIN_RATE_HZ:
        raise InputError(
            "wrong_unit",
            f"{slow.name} is sampled at {slow.rate_hz:.3g} Hz; t must be in s (is it in ms or us?)",
        )


def choose_preparation(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...] = ()) -> Preparation:
    """Choose filters and masks for logs that will be fitted together.

    Args:
        robot: The robot, with the actuated joints.
        logs: Even stretches.
        exclude: Columns whose nonzero samples are left out.

    Raises:
        CannotAnswer: No joint moves above its encoder's noise.
    """
    short = min(logs, key=lambda log: log.n_samples)
    if short.n_samples < MIN_SEGMENT_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{short.name} has {short.n_samples} samples in a row; {MIN_SEGMENT_SAMPLES} are needed for an answer",
        )
    refuse_slow_clocks(logs)
    rate = min(log.rate_hz for log in logs)
    bands = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz) for log in logs]
    edge = max(float(band.edge_hz.max()) for band in bands)
    if edge <= 0:
        raise CannotAnswer(
            "poor_excitation",
            f"no joint moves above its encoder's noise in {', '.join(log.name for log in logs)}",
            f"move {', '.join(robot.actuated)} in both directions, over several speeds, for a minute or more",
        )
    force_cutoff = choose_force_cutoff(bands, rate, BAND_FACTOR)
    position_cutoff = min(POSITION_FACTOR * force_cutoff, 0.4 * rate)
    if robot.base_coordinates:
        force_cutoff, position_cutoff = _choose_floating_cutoffs(robot, logs, bands, force_cutoff)
    rests = [
        compute_rest_speed(log.joint("q", robot.actuated), log.rate_hz, position_cutoff, NOISE_FACTOR) for log in logs
    ]
    return Preparation(
        position_cutoff,
        force_cutoff,
        RATE_FACTOR * force_cutoff,
        np.max(rests, axis=0),
        MEMORY / position_cutoff,
        exclude,
    )


FLIGHT_FACTOR = 8.0
"""Low-pass of positions times the time a foot is in the air: contacts last longer by two periods of it, the filter's memory, on
each side, and half of the flight is left. Twice as much lets in noise of speeds that biases friction of a Go2 by 5 %."""


def _choose_floating_cutoffs(
    robot: Robot, logs: Sequence[Log], bands: Sequence[MotionBand], usual: float
) -> tuple[float, float]:
    """Return the low-passes [Hz] of forces and of positions of a robot with a floating base.

    The base's pose is much noisier than encoders, and its accelerations are in all columns. So forces and columns pass up to
    the frequency at which the noisiest coordinate of the base has 1e-4 of its acceleration's power, even if stepping feet move
    faster: the equations hold for any part of the motion. Positions pass more than that, so that a step of a foot stays sharp.
    """
    n = len(robot.base_coordinates)
    edges = [band.noise_edge_hz[:n][band.edge_hz[:n] > 0] for band in bands]
    noisy = min((float(x.min()) for x in edges if x.size), default=usual)
    rate = min(log.rate_hz for log in logs)
    flight = find_usual_flight([(find_contacts(robot, log), log.dt) for log in logs])
    force_cutoff = min(usual, noisy)
    wanted = max(POSITION_FACTOR * force_cutoff, FLIGHT_FACTOR / flight if flight else 0.0)
    return force_cutoff, min(wanted, 0.4 * rate)


def compute_base_cutoff(preparation: Preparation, rate_hz: float) -> float:
    """Return the low-pass [Hz] of a floating base's pose, at most that of the joints' positions.

    Its noise is large and enters products: the product of an angle's noise `n` with its acceleration's noise has the mean
    `-mean((dn/dt)^2)`, which no later filter removes.
    """
    return min(POSITION_FACTOR * preparation.force_cutoff_hz, preparation.position_cutoff_hz, 0.4 * rate_hz)


CODE = "short_log"

BAND_SHARE = 0.1
"""Part of the longest piece's length from which a piece counts in the choice of filters; a shorter one resolves no band."""

INFORMATION_PER_PARAMETER = 2.0
"""Independent values for each of `p` base parameters below which a log is called short: fewer than `p` are left for the residual,
and standard errors are themselves off by more than `1 / sqrt(2 p)`, 9 % for the 64 of a six-axis arm."""

EXPERIMENT = "record half a minute or more without gaps, in both directions and over several speeds"


class TooShort(CannotAnswer):
    """No piece of the logs is long enough for the filters."""


AnyPiece = TypeVar("AnyPiece", bound=Log | EvenSegment | InMemorySegment)


class Kept(NamedTuple):
    """Indices of the pieces that are long enough, and warnings about the others."""

    index: tuple[int, ...]
    warnings: tuple[str, ...]

    def of(self, pieces: Sequence[AnyPiece]) -> list[AnyPiece]:
        """Return the pieces that are kept."""
        return [pieces[k] for k in self.index]


def select_long(pieces: Sequence[AnyPiece]) -> list[AnyPiece]:
    """Return the pieces for the choice of filters: those long enough to resolve a band, and those of a lower rate."""
    longest = max(piece.n_samples / piece.rate_hz for piece in pieces)
    long = [piece for piece in pieces if piece.n_samples / piece.rate_hz >= BAND_SHARE * longest]
    slowest_hz = min(piece.rate_hz for piece in long)
    return [piece for piece in pieces if piece in long or piece.rate_hz < 0.99 * slowest_hz]


def keep_long(
    pieces: Sequence[Log | EvenSegment | InMemorySegment], cutoff_hz: float, factor: Callable[[float], int]
) -> Kept:
    """Separate the pieces that give rows from those that are shorter than the ends that a low-pass disturbs.

    Args:
        pieces: Even stretches, of one log or of several.
        cutoff_hz: The lowest cutoff of the filters [Hz].
        factor: Function from a sampling rate [Hz] to the decimation.

    Raises:
        TooShort: No piece is long enough.
    """
    needed = [compute_min_samples(cutoff_hz, piece.rate_hz, factor(piece.rate_hz)) for piece in pieces]
    index = tuple(k for k, (piece, n) in enumerate(zip(pieces, needed, strict=True)) if piece.n_samples >= n)
    seconds = max((n / piece.rate_hz for piece, n in zip(pieces, needed, strict=True)), default=0.0)
    if not index:
        raise refuse_short(pieces, seconds)
    return Kept(index, _left_out(pieces, index, seconds))


def compute_min_samples(cutoff_hz: float, rate_hz: float, factor: int) -> int:
    """Return the least number of samples of a piece that gives a row between the ends that a low-pass disturbs."""
    return 2 * (compute_edge_samples(cutoff_hz, rate_hz) + factor) + 1


def refuse_short(pieces: Sequence[Log | EvenSegment | InMemorySegment], needed_s: float) -> TooShort:
    """Return the error for logs without a piece of the length that the filters need [s]."""
    names = ", ".join(dict.fromkeys(piece.name for piece in pieces))
    longest = max((piece.n_samples / piece.rate_hz for piece in pieces), default=0.0)
    return TooShort(
        "too_little_data",
        f"no piece of {names} without a gap is long enough: the longest lasts {longest:.2g} s, and the filters that this "
        f"motion needs take {needed_s:.2g} s",
        EXPERIMENT,
    )


def _left_out(
    pieces: Sequence[Log | EvenSegment | InMemorySegment], index: Sequence[int], needed_s: float
) -> tuple[str, ...]:
    said = []
    for name in dict.fromkeys(piece.name for piece in pieces):
        lengths = [
            (k in index, piece.n_samples / piece.rate_hz) for k, piece in enumerate(pieces) if piece.name == name
        ]
        short = [seconds for kept, seconds in lengths if not kept]
        if short:
            said.append(
                f"{name}: {len(short)} of {count(len(lengths), 'piece')} without a gap {'is' if len(short) == 1 else 'are'} "
                f"shorter than the {needed_s:.2g} s that the filters need; {sum(short):.3g} of "
                f"{sum(seconds for _, seconds in lengths):.3g} s are left out"
            )
    return tuple(CodedWarning(CODE, sentence) for sentence in said)


def list_crumbs(logs: Sequence[Log | Recording]) -> list[str]:
    """Return warnings about pieces between gaps that are too short to be listed as pieces."""
    said = []
    for log in logs:
        n, seconds = count_short_segments(log) if isinstance(log, Log) else (0, 0.0)
        if n:
            sentence = f"{log.name}: {count(n, 'piece')} of fewer than 10 samples between gaps, {seconds:.3g} s in all, left out"
            said.append(CodedWarning(CODE, sentence))
    return said


def count_information(regression: Regression, band_hz: float | None = None) -> float:
    """Return the number of independent values in a regression: twice the motion's band times its usable time, over all outputs.

    Args:
        regression: The data.
        band_hz: The motion's band [Hz]; by default that from which the filters of an identification were chosen.
    """
    seconds = sum(float(run.usable.sum()) * _step(run.t) for run in regression.runs)
    return 2 * (band_hz or regression.preparation.force_cutoff_hz / BAND_FACTOR) * seconds


def _step(t: np.ndarray) -> float:
    return float(t[-1] - t[0]) / (len(t) - 1) if len(t) > 1 else 0.0


def list_information_warnings(regression: Regression, rank: int, band_hz: float | None = None) -> list[str]:
    """Return a warning if the logs hold little independent information for a rank."""
    if regression.everything is not None:
        return []  # a recording larger than memory
    held = count_information(regression, band_hz)
    if held >= INFORMATION_PER_PARAMETER * rank:
        return []
    return [
        CodedWarning(
            CODE,
            f"the logs hold about {held:.0f} independent values for {rank} parameters and combinations, so intervals are "
            f"wide and themselves unsure; {EXPERIMENT}",
        )
    ]


def refuse_missing_temperature(model: Model, log: Log, measured: Mapping[str, np.ndarray]) -> None:
    """Refuse a log without the temperatures that an effect of the model follows."""
    feeling = [effect.name for effect in model.effects if "temperature" in effect.needs]
    if not feeling:
        return
    columns = f"{ROOM_TEMPERATURE} or {', '.join(f'temp_{j}' for j in model.robot.actuated)}"
    if "temperature" not in measured:
        raise InputError(
            "missing_column", f"{log.name} has no column {columns}, which effect {feeling[0]} of the model needs"
        )
    if not np.all(np.isfinite(measured["temperature"])):
        raise InputError(
            "bad_sample", f"{log.name}: a sample of {columns}, which effect {feeling[0]} needs, is no finite number"
        )


def refuse_missing_campaign(model: Model, names: Sequence[str]) -> None:
    """Refuse fewer logs than an effect refers to."""
    for effect in model.effects:
        number = int(effect.settings.get("number", 0))
        if "campaign" in effect.needs and number >= len(names):
            raise InputError(
                "unsupported",
                f"effect {effect.name} separates log {number + 1} from others, and there is only {len(names)}: give the logs "
                "in the order in which it was found, or fit the model without it",
            )


SATURATION_RATIO = 0.999
"""Share of a drive's limit from which a force counts as saturated."""


def compute_gate(log: Log, motion: Motion, model: Model, preparation: Preparation, rate: float) -> np.ndarray:
    """Return 1 for each joint's usable samples and 0 for others (N, na), at the log's own rate."""
    threshold = preparation.speed_threshold
    shut = find_unsure_samples(motion.v, threshold)
    for effect in model.effects:
        if type(effect).other_speeds is Effect.other_speeds:
            continue
        computed = [name for name in effect.needs if name in COMPUTED]
        felt = {name: COMPUTED[name](model.mechanism, motion.q, motion.v, motion.a) for name in computed}
        for speed, indices in effect.other_speeds(replace(motion, signals={**motion.signals, **felt})):
            shut[:, indices] |= find_unsure_samples(speed, float(np.hypot.reduce(threshold[indices])))[:, None]
    shut |= find_excluded_samples(log, model.robot.actuated, model.robot.effort_limit, preparation.exclude)
    half = int(np.ceil(preparation.window_s * rate - ROUNDING))
    gate = 1.0 - widen(shut, half)
    ramp = np.hanning(2 * int(np.ceil(rate / preparation.position_cutoff_hz - ROUNDING)) + 3)
    return convolve1d(gate, ramp / ramp.sum(), axis=0, mode="nearest")


def compute_contact_gate(
    log: Log, q: np.ndarray, model: Model, preparation: Preparation, rate: float
) -> tuple[ContactElimination, np.ndarray]:
    """Return the elimination of contacts from the equations at positions (N, na), and 1 for a usable equation, 0 for others.

    Touching down and lifting off spread as far as the first filter's memory, so contacts last longer by it on both sides. An
    equation holds the friction of several joints, of which one or another always reverses; no sample is left out for that.
    """
    ramp = int(np.ceil(rate / preparation.position_cutoff_hz - ROUNDING))
    half = int(np.ceil(preparation.window_s * rate - ROUNDING))
    touching = widen(find_contacts(model.robot, log), half + 1)
    found = eliminate_contacts(model.robot, q, touching)
    joints, limit = model.robot.actuated, model.robot.effort_limit
    left_out = np.atleast_2d(find_excluded_samples(log, joints, limit, preparation.exclude).any(axis=1)).T
    gate = np.where(widen(left_out, half), 0.0, found.free)
    weights = np.hanning(2 * ramp + 3)
    return found, convolve1d(gate, weights / weights.sum(), axis=0, mode="nearest")


def compute_expected_direction(v: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the mean sign (N, na) of true speeds, given measured ones (N, na) with normal noise (na,): `erf(v / sqrt(2) noise)`.

    It replaces the sign if samples next to a reversal stay in the fit.
    """
    return np.where(noise > 0, erf(v / (np.sqrt(2) * np.maximum(noise, 1e-300))), np.sign(v))


def widen(shut: np.ndarray, half: int) -> np.ndarray:
    """Return where a sample (N, na) or one at most `half` away is shut."""
    n = len(shut)
    count = np.concatenate([np.zeros((1, shut.shape[1]), int), np.cumsum(shut, axis=0)])
    i = np.arange(n)
    return count[np.minimum(i + half + 1, n)] > count[np.maximum(i - half, 0)]


def hold_closed(gate: np.ndarray, n: int) -> np.ndarray:
    """Return the least of a gate (N,) over each sample and the n before it; the -n after it for n < 0."""
    origin = n // 2 if n > 0 else -((1 - n) // 2)
    return gate if n == 0 else minimum_filter1d(gate, abs(n) + 1, mode="nearest", origin=origin)


def find_unsure_samples(speed: np.ndarray, threshold: float | np.ndarray) -> np.ndarray:
    """Return where speeds (N,) or (N, na) have no sure sign: too slow, or just reversed."""
    unsure = np.abs(speed) <= threshold  # a joint at rest has no sign, even without noise
    unsure[1:] |= np.sign(speed[1:]) != np.sign(speed[:-1])
    return unsure


def find_excluded_samples(
    log: Log, joints: tuple[str, ...], effort_limit: np.ndarray, columns: tuple[str, ...]
) -> np.ndarray:
    """Return saturated samples and those a column flags with anything but zero (N, na)."""
    bad = np.abs(log.joint("tau", joints)) >= SATURATION_RATIO * effort_limit
    for column in columns:
        if column not in log.channels:
            raise InputError("missing_column", f"{log.name} has no column {column} to exclude samples by")
        bad |= (log.channels[column] != 0)[:, None]
    return bad


def refuse_jumps(log: Log, robot: Robot, columns: tuple[str, ...]) -> None:
    """Refuse positions that no joint can follow, as filters would turn jumps into motion; samples that a column flags may jump.

    Args:
        log: A log before any interpolation, or an even stretch.
        robot: The robot.
        columns: Columns whose nonzero samples are left out.

    Raises:
        InputError: A joint's position jumps.
    """
    left_out = np.zeros(log.n_samples, bool)
    for column in columns:
        left_out |= log.channels.get(column, left_out) != 0
    gaps = examine_clock(log).gaps
    for joint, kind, fastest in zip(robot.actuated, robot.joint_kinds, robot.velocity_limit, strict=True):
        if not log.has("q", [joint]):
            continue
        found = check_jumps(
            log, joint, revolute=kind != "prismatic", fastest=float(fastest), left_out=left_out, gaps=gaps
        )
        if found is not None:
            raise InputError("bad_sample", f"{found.sentence} {found.remedy}")
