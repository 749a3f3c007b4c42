"""An even clock for filters that need one: uneven samples are interpolated, gaps are never bridged.

Stamps that are even but rounded to few digits are recognised and replaced by the even clock without touching the
channels. Truly uneven stamps (more than 1 % of a step off, or one or two samples lost) are resampled with one cubic
spline a channel: its error falls with dt^4, where a straight line would cut the peaks of an acceleration by up to `a
dt^2 / 8` and halve the noise between samples but not at them. All channels go through the same linear operation, so no
fit sees `q` and `tau` treated differently. Three or more lost samples in a row are a gap, and `split_at_gaps` cuts the log
there.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tau_dyn.exceptions import InputError
from tau_dyn.log.column_names import count
from tau_dyn.log.log import Log

MAX_RELATIVE_JITTER = 0.01
"""Steps may differ by this share of their mean before a clock counts as uneven."""

MIN_GAP_STEPS = 3.5
"""A step longer than this many usual ones (three samples lost, or more) is a gap."""

MIN_SEGMENT_SAMPLES = 10
"""Segments with fewer samples are left out."""


class Clock(NamedTuple):
    """What a log's clock looks like."""

    dt: float
    """Mean of the usual steps [s], those within half of their median."""
    jitter: float
    """Largest deviation of a step from `dt`, gaps and lost samples left out, as a share of it."""
    n_missing: int
    """Samples lost, in gaps and one by one."""
    gaps: tuple[int, ...]
    """Samples after which a gap follows."""
    rounded: bool
    """True where the stamps are an even clock written with few digits."""

    @property
    def even(self) -> bool:
        """True where filters may take the samples as they are."""
        return not self.gaps and self.n_missing == 0 and self.jitter <= MAX_RELATIVE_JITTER


def examine_clock(log: Log) -> Clock:
    """Measure the steps of a log's clock."""
    if is_rounded(log.t):
        return Clock(log.duration / (log.n_samples - 1), 0.0, 0, (), rounded=True)
    steps = np.diff(log.t)
    usual = steps[np.abs(steps / log.dt - 1) < 0.5]
    dt = float(np.mean(usual)) if usual.size else log.dt  # two step lengths by turns: the median is neither
    ratio = steps / dt
    missing = np.maximum(np.round(ratio) - 1, 0)
    usual = np.abs(ratio[missing == 0] - 1)
    jitter = float(usual.max()) if usual.size else 0.0
    return Clock(dt, jitter, int(missing.sum()), tuple(np.flatnonzero(ratio > MIN_GAP_STEPS).tolist()), rounded=False)


def split_at_gaps(log: Log) -> list[Log]:
    """Cut a log at its gaps; each part says so in its warnings, and parts with fewer than 10 samples are left out."""
    clock = examine_clock(log)
    if not clock.gaps:
        return [log]
    spans = [(a, b) for a, b in _spans(log, clock) if b - a >= MIN_SEGMENT_SAMPLES]
    return [log.window(a, b).with_warnings(describe_gaps(log, clock)) for a, b in spans]


def resample_segments(log: Log) -> list[Log]:
    """Return a log's parts between gaps, each on an even clock.

    What is a gap is decided by the whole log's step: a part's own may be a little shorter.
    """
    return [_resample(part, examine_clock(part)) for part in split_at_gaps(log)]


def count_short_segments(log: Log) -> tuple[int, float]:
    """Return how many parts between gaps `split_at_gaps` leaves out, and how long they are together [s]."""
    clock = examine_clock(log)
    sizes = [b - a for a, b in _spans(log, clock) if b - a < MIN_SEGMENT_SAMPLES] if clock.gaps else []
    return len(sizes), sum(sizes) * clock.dt


def _spans(log: Log, clock: Clock) -> list[tuple[int, int]]:
    """Return the first sample of each part between gaps, and the one after its last."""
    ends = [0, *(i + 1 for i in clock.gaps), log.n_samples]
    return list(zip(ends[:-1], ends[1:], strict=True))


def ensure_even(log: Log) -> Log:
    """Return the log on an even clock, untouched where it has one already.

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
    n_steps = log.n_samples - 1 if clock.rounded else round(log.duration / clock.dt)
    grid = np.linspace(log.t[0], log.t[-1], n_steps + 1)
    if clock.rounded:
        sentence = (
            f"{log.name}: its times are rounded; an even clock of {n_steps / log.duration:.6g} Hz was used instead."
        )
        return Log(grid, log.channels, log.name, log.sha256, log.warnings).with_warnings(sentence)
    channels = {key: interpolate(log.t, values, grid) for key, values in log.channels.items()}
    return Log(grid, channels, log.name, log.sha256, log.warnings).with_warnings(_uneven_sentence(log, clock))


def describe_gaps(log: Log, clock: Clock) -> str:
    """Return a sentence naming a log's gaps."""
    places = [f"{log.t[i + 1] - log.t[i]:.3g} s after t = {log.t[i]:.6g} s" for i in clock.gaps[:3]]
    more = f" and {len(clock.gaps) - 3} more" if len(clock.gaps) > 3 else ""
    return f"{log.name} has {count(len(clock.gaps), 'gap')} in time: {', '.join(places)}{more}; it is cut there, not bridged."


def _uneven_sentence(log: Log, clock: Clock) -> str:
    lost = (
        f" and {count(clock.n_missing, 'sample')} {'is' if clock.n_missing == 1 else 'are'} missing"
        if clock.n_missing
        else ""
    )
    return (
        f"{log.name}: its steps vary by up to {100 * clock.jitter:.2g} % of {clock.dt:.4g} s{lost}; "
        "all channels were interpolated onto an even clock."
    )


def interpolate(t: NDArray[np.float64], values: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a channel on another clock; one with holes keeps them."""
    if np.all(np.isfinite(values)) and len(t) >= 4:
        try:
            with np.errstate(all="ignore"):
                return CubicSpline(t, values)(grid)
        except ValueError:  # slopes beyond a float, of numbers near 1e308 or of steps near nothing
            pass
    return np.interp(grid, t, values)  # a foreign channel with holes keeps them


def is_rounded(t: NDArray[np.float64]) -> bool:
    """Tell whether uneven stamps are an even clock rounded to a decimal place coarser than 1 % of its step."""
    dt = (t[-1] - t[0]) / (len(t) - 1)
    decimals = next((d for d in range(10) if np.allclose(np.round(t, d), t, rtol=0.0, atol=1e-10)), None)
    if decimals is None or 10.0**-decimals <= MAX_RELATIVE_JITTER * dt:
        return False
    line = np.polynomial.Polynomial.fit(np.arange(len(t)), t, 1)(np.arange(len(t)))
    uneven = np.ptp(np.diff(t)) > MAX_RELATIVE_JITTER * dt
    return bool(uneven and np.max(np.abs(t - line)) <= 0.75 * 10.0**-decimals)
