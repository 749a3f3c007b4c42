"""An even clock for filters that need one, a log cut at gaps and at rests, and a signal of one clock on another clock.

Uneven samples are interpolated. Gaps are not, unless the samples around determine the missing ones. Stamps that are even but
rounded to few digits are recognised and replaced by the even clock without touching the channels.
Truly uneven stamps (more than 1 % of a step off, or one or two
samples lost) are resampled with one cubic spline for each channel: its error falls with dt^4, where a straight line would cut the
peaks of an acceleration by up to `a dt^2 / 8` and halve the noise between samples but not at them. All channels go through the
same linear operation, so no fit sees `q` and `tau` treated differently. Three or more lost samples in a row are a gap, and
`split_at_gaps` cuts the log there.

Predicting every second sample from those between shows the spline's error: the prediction error is about sixteen times the error
at the full rate. A signal whose every second sample cannot be predicted from its neighbours changes too fast for its own clock;
no interpolation recovers the values between its samples. Signals are not extrapolated. Reference: de Boor 2001 (error of the
cubic spline).

**Short gaps** are filled by `fill_short_gaps` before a log is cut. A filter runs over a gap only if it is filled, and a log that
is cut at every gap loses a filter's memory on both sides: a log with a gap every half second would lose all its samples. The
missing rows can be interpolated if the motion is slow compared with the gap. The log itself shows the accuracy: in parts
without a gap, rows are left out as in the gap, and the cubic spline through their neighbours is compared with them. The error
at a single row that is left out is little more than its noise. A gap is filled if the median error in the middle of an equally
long trial gap is at most three times that, in all positions. Without noise the error grows with the fourth power of the gap,
and the gap is kept. Forces are filled where positions are: the spline's error of a force is noise of a few rows on the left
side of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tau_dyn.exceptions import InputError
from tau_dyn.log.filtering import estimate_encoder_noise
from tau_dyn.log.log import Log
from tau_dyn.results import count


def find_true_runs(mask: np.ndarray) -> list[slice]:
    """Return the stretches of samples (n,) at which a mask is true, in time order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


MAX_RELATIVE_JITTER = 0.01
"""Steps may differ by this share of their mean before a clock counts as uneven."""

MIN_GAP_STEPS = 3.5
"""A step longer than this many usual ones (three samples lost, or more) is a gap."""

MIN_SEGMENT_SAMPLES = 10
"""Segments with fewer samples are left out."""


class Clock(NamedTuple):
    """Properties of a log's clock."""

    dt: float
    """Mean of the usual steps [s], those within half of their median."""
    jitter: float
    """Largest deviation of a step from `dt`, gaps and lost samples left out, as a share of it."""
    n_missing: int
    """Samples lost, in gaps and one by one."""
    gaps: tuple[int, ...]
    """Samples after which a gap follows."""
    rounded: bool
    """True if the stamps are an even clock written with few digits."""

    @property
    def even(self) -> bool:
        """True if filters may use the samples without resampling."""
        return not self.gaps and self.n_missing == 0 and self.jitter <= MAX_RELATIVE_JITTER


def examine_clock(log: Log) -> Clock:
    """Measure the steps of a log's clock."""
    if is_rounded(log.t):
        return Clock(log.duration / (log.n_samples - 1), 0.0, 0, (), rounded=True)
    steps = np.diff(log.t)
    usual = steps[np.abs(steps / log.dt - 1) < 0.5]
    dt = float(np.mean(usual)) if usual.size else log.dt  # two step lengths in alternation: the median is neither
    ratio = steps / dt
    missing = np.maximum(np.round(ratio) - 1, 0)
    usual = np.abs(ratio[missing == 0] - 1)
    jitter = float(usual.max()) if usual.size else 0.0
    return Clock(dt, jitter, int(missing.sum()), tuple(np.flatnonzero(ratio > MIN_GAP_STEPS).tolist()), rounded=False)


def split_at_gaps(log: Log) -> list[Log]:
    """Cut a log at its gaps; each part has a warning about it, and parts with fewer than 10 samples are left out."""
    clock = examine_clock(log)
    if not clock.gaps:
        return [log]
    spans = [(a, b) for a, b in _spans(log, clock) if b - a >= MIN_SEGMENT_SAMPLES]
    return [log.window(a, b).with_warnings(describe_gaps(log, clock)) for a, b in spans]


def resample_segments(log: Log) -> list[Log]:
    """Return a log's parts between gaps, each on an even clock.

    The whole log's step decides which steps are gaps, as a part's own step may be a little shorter.
    """
    return [_resample(part, examine_clock(part)) for part in split_at_gaps(log)]


def count_short_segments(log: Log) -> tuple[int, float]:
    """Return the number of parts between gaps that `split_at_gaps` leaves out, and their total length [s]."""
    clock = examine_clock(log)
    sizes = [b - a for a, b in _spans(log, clock) if b - a < MIN_SEGMENT_SAMPLES] if clock.gaps else []
    return len(sizes), sum(sizes) * clock.dt


def _spans(log: Log, clock: Clock) -> list[tuple[int, int]]:
    """Return the first sample of each part between gaps, and the one after its last."""
    ends = [0, *(i + 1 for i in clock.gaps), log.n_samples]
    return list(zip(ends[:-1], ends[1:], strict=True))


def ensure_even(log: Log) -> Log:
    """Return the log on an even clock, unchanged if it has one already.

    Args:
        log: A log without gaps.

    Returns:
        The log, or its samples on a grid of as many steps between its first and last time, with a warning sentence.

    Raises:
        InputError: The log has a gap, over which interpolation would invent motion.
    """
    clock = examine_clock(log)
    if clock.gaps:
        raise InputError("time_stamps", describe_gaps(log, clock) + " Pass the parts as separate logs.")
    return _resample(log, clock)


def _resample(log: Log, clock: Clock) -> Log:
    if clock.even and not clock.rounded:
        return log
    if clock.rounded:
        return mend_rounded_stamps(log)
    grid = np.linspace(log.t[0], log.t[-1], round(log.duration / clock.dt) + 1)
    channels = {key: interpolate(log.t, values, grid) for key, values in log.channels.items()}
    return replace(log, t=grid, channels=channels).with_warnings(_uneven_sentence(log, clock))


def mend_rounded_stamps(log: Log) -> Log:
    """Return a log with an even clock of the same samples where its stamps are one written with few digits, with a warning."""
    if not is_rounded(log.t):
        return log
    n_steps = log.n_samples - 1
    sentence = f"{log.name}: its times are rounded; an even clock of {n_steps / log.duration:.6g} Hz was used instead."
    return replace(log, t=np.linspace(log.t[0], log.t[-1], n_steps + 1)).with_warnings(sentence)


def describe_gaps(log: Log, clock: Clock) -> str:
    """Return a sentence naming a log's gaps."""
    places = [f"{log.t[i + 1] - log.t[i]:.3g} s after t = {log.t[i]:.6g} s" for i in clock.gaps[:3]]
    more = f" and {len(clock.gaps) - 3} more" if len(clock.gaps) > 3 else ""
    return f"{log.name} has {count(len(clock.gaps), 'gap')} in time: {', '.join(places)}{more}; it is cut there, not bridged."


_STEADY = 1e-4
"""Relative variation of steps below which only missing samples make a clock uneven."""


def _uneven_sentence(log: Log, clock: Clock) -> str:
    lost = f"{count(clock.n_missing, 'sample')} {'is' if clock.n_missing == 1 else 'are'} missing"
    varying = f"its steps vary by up to {100 * clock.jitter:.2g} % of {clock.dt:.4g} s"
    said = [varying] if clock.jitter > _STEADY or not clock.n_missing else []
    said += [lost] if clock.n_missing else []
    return f"{log.name}: {' and '.join(said)}; all channels were interpolated onto an even clock."


def interpolate(t: NDArray[np.float64], values: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a channel on another clock; one with holes keeps them."""
    if np.all(np.isfinite(values)) and len(t) >= 4:
        try:
            with np.errstate(all="ignore"):
                return CubicSpline(t, values)(grid)
        except ValueError:  # slopes beyond a float, from numbers near 1e308 or steps near zero
            pass
    return np.interp(grid, t, values)  # a foreign channel with holes keeps them


def is_rounded(t: NDArray[np.float64]) -> bool:
    """Return whether uneven stamps are an even clock rounded to a decimal place coarser than 1 % of its step."""
    dt = (t[-1] - t[0]) / (len(t) - 1)
    decimals = next((d for d in range(10) if np.allclose(np.round(t, d), t, rtol=0.0, atol=1e-10)), None)
    if decimals is None or 10.0**-decimals <= MAX_RELATIVE_JITTER * dt:
        return False
    line = np.polynomial.Polynomial.fit(np.arange(len(t)), t, 1)(np.arange(len(t)))
    uneven = np.ptp(np.diff(t)) > MAX_RELATIVE_JITTER * dt
    return bool(uneven and np.max(np.abs(t - line)) <= 0.75 * 10.0**-decimals)


_SIGMA = 6.0  # standard deviations of the noise; not one of 1e8 samples exceeds them
_LOOK_S = 0.1  # [s] over which travel is measured


def split_by_motion(log: Log, *, rest_s: float = 0.5, least_s: float = 1.0) -> list[Log]:
    """Return a log's motions: the stretches between rests, each with half of the rests around it.

    The robot rests if, for `rest_s` or longer, no joint travels more in 0.1 s than six times its encoder's noise.

    Args:
        log: Positions `q_J` of at least one joint, evenly sampled.
        rest_s: Shortest rest that separates two motions [s].
        least_s: Shortest motion worth keeping [s]; shorter ones are left out.

    Returns:
        Parts in time order; the whole log if it never rests, an empty list if it never moves.
    """
    moving = _moving(log)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if not starts.size:
        return []
    apart = np.flatnonzero((starts[1:] - stops[:-1]) * log.dt >= rest_s)
    firsts, lasts = np.r_[starts[0], starts[apart + 1]], np.r_[stops[apart], stops[-1]]
    cuts = np.r_[0, (lasts[:-1] + firsts[1:]) // 2, log.n_samples]
    kept = (lasts - firsts) * log.dt >= least_s
    return [log.window(int(a), int(b)) for a, b, keep in zip(cuts[:-1], cuts[1:], kept, strict=True) if keep]


def _moving(log: Log) -> NDArray[np.bool_]:
    """Return the samples (N,) at which some joint moves, over windows long enough compared with its noise."""
    q = log.joint("q", log.joints("q"))
    width = min(max(2, round(_LOOK_S / log.dt)), log.n_samples - 1)
    travel = np.abs(q[width:] - q[:-width])
    noise = np.sqrt(2) * estimate_encoder_noise(q)
    went = np.any(travel > np.maximum(_SIGMA * noise, 1e-12), axis=1)
    return np.concatenate([np.full(width // 2, went[0]), went, np.full(width - width // 2, went[-1])])


MAX_INTERPOLATION_ERROR = 0.5
"""Largest error of predicting a signal from its neighbours at twice the step, as a share of its spread."""

MIN_CLOCK_SAMPLES = 10  # fewer give no rate


def resample_to_clock(where: str, t: np.ndarray, x: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, str]:
    """Return a signal at other times.

    Args:
        where: The file and column, to open a sentence.
        t: Its own times (N,) [s], increasing.
        x: Its samples (N,), finite.
        wanted: Times (M,) [s] within its first and last.

    Returns:
        The samples (M,), and a sentence about the method; empty if every wanted time is one of its own.

    Raises:
        InputError: It has gaps there, or changes too fast for its own clock.
    """
    at = np.minimum(np.searchsorted(t, wanted), t.size - 1)
    if np.array_equal(t[at], wanted):
        return x[at], ""
    if t.size < MIN_CLOCK_SAMPLES:
        raise InputError("too_little_data", f"{where} has {t.size} samples, too few to be put on another clock.")
    step = float(np.median(np.diff(t)))
    inside = (t >= wanted[0] - step) & (t <= wanted[-1] + step)
    t, x = t[inside], x[inside]
    if t.size < MIN_CLOCK_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{where} has {t.size} samples during the log, too few to be put on another clock.",
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
            f"{where} cannot be put on another clock: its samples ({1 / step:.4g} Hz) cannot be found from their "
            "neighbours, so the motion between them is unknown; record both in one message, or faster.",
        )
    error = 100 * share / 16
    return CubicSpline(t, x)(wanted), f"interpolated from {1 / step:.4g} Hz, error about {max(error, 0.01):.2g} %"


def estimate_interpolation_error(t: np.ndarray, x: np.ndarray) -> float:
    """Return the deviation of every second sample from a spline through the others, as a share of the signal's spread."""
    spread = float(np.std(x))
    if spread <= 1e-12 * max(1.0, float(np.max(np.abs(x)))):
        return 0.0
    missed = (CubicSpline(t[::2], x[::2])(t[1::2]) - x[1::2])[1:-1]
    return float(np.sqrt(np.mean(missed**2))) / spread


MAX_MISS = 3.0
"""Largest median error of a filled row over that of a single row that is left out."""

MAX_FILLED_SHARE = 0.02
"""Largest share of the rows that may be filled, as these are no measurements."""

_N_TRIALS = 200  # rows that are left out, one at a time; their median error is known to a tenth
_AROUND = 8
"""Rows on each side of a gap through which the spline of a trial runs."""


def fill_short_gaps(log: Log, joints: Sequence[str]) -> tuple[Log, int, float]:
    """Return the log with its short gaps filled, how many gaps these were, and the longest [s].

    Args:
        log: A log with measured times.
        joints: Joints whose positions are compared with the spline.
    """
    clock = examine_clock(log)
    steps = np.diff(log.t)
    sizes = np.round(steps / clock.dt).astype(int)
    gaps = np.flatnonzero(steps > MIN_GAP_STEPS * clock.dt)
    if not gaps.size or not log.has("q", joints):
        return log, 0, 0.0
    longest = _find_longest(log.t, log.joint("q", joints), sorted(set(sizes[gaps].tolist())))
    short = gaps[sizes[gaps] <= longest]
    missing = int(np.sum(sizes[short] - 1))
    if not short.size or missing > MAX_FILLED_SHARE * log.n_samples:
        return log, 0, 0.0
    inserted = [log.t[i] + steps[i] * np.arange(1, int(sizes[i])) / sizes[i] for i in short]
    t = np.sort(np.concatenate([log.t, *inserted]))
    kept = np.searchsorted(t, log.t)
    channels = {}
    for key, values in log.channels.items():
        channels[key] = interpolate(log.t, values, t)
        channels[key][kept] = values
    return Log(t, channels, log.name, log.sha256, log.warnings), len(short), float(steps[short].max())


def _find_longest(t: NDArray[np.float64], x: NDArray[np.float64], sizes: Sequence[int]) -> int:
    """Return the longest of gap sizes [steps] that the rows around predict well enough; 0 without any."""
    if len(t) < _N_TRIALS or not np.isfinite(x).all():
        return 0
    single, longest = _measure_miss(t, x, 2), 0
    for size in sizes:
        if len(t) < 4 * (size + 2 * _AROUND) or np.any(_measure_miss(t, x, size) > MAX_MISS * single):
            break
        longest = size
    return longest


def _measure_miss(t: NDArray[np.float64], x: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the median error (n,) of splines at rows (N, n) in the middle of trial gaps of `size` steps."""
    row = np.concatenate([np.arange(1 - _AROUND, 1), np.arange(size, size + _AROUND)])
    middle = size // 2
    starts = np.linspace(_AROUND, len(t) - size - _AROUND, _N_TRIALS).astype(int)
    missed = [CubicSpline(t[i + row], x[i + row])(t[i + middle]) - x[i + middle] for i in starts]
    return np.median(np.abs(missed), axis=0)
