"""Rows that a logger missed, filled in where the rows around tell them as well as a measurement would.

A filter runs over a gap only if something stands there, and a log that is cut at every gap loses a filter's memory on both sides:
of a log with a gap every half second nothing is left. What would stand in a gap is known where the motion is slow against it.
The log itself tells how well: where it has no gap, rows are left out as the gap does, and the cubic spline through their
neighbours is held against them. A single row that is left out is missed by little more than its noise. A gap is filled if rows
in the midst of one as long are missed by at most three times as much in all positions, by the median. Without noise the miss
grows with the fourth power of the gap, and the gap stays. Forces follow the positions: what the spline misses of them is noise
of a few rows on the left side of a fit. Reference: de Boor 2001.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tau_dyn.log.log import Log
from tau_dyn.log.resample import MIN_GAP_STEPS, examine_clock, interpolate

MAX_MISS = 3.0
"""Largest median miss of a filled row over that of a single row that is left out."""

MAX_FILLED_SHARE = 0.02
"""Share of the rows that may be filled in: they are no measurements."""

_N_TRIALS = 200  # rows that are left out, one at a time; their median miss is known to a tenth
_AROUND = 8
"""Rows on each side of a gap through which the spline of a trial runs."""


def fill_short_gaps(log: Log, joints: Sequence[str]) -> tuple[Log, int, float]:
    """Return the log with its short gaps filled, how many gaps these were, and the longest [s].

    Args:
        log: A log with measured times.
        joints: Joints whose positions are held against the spline.
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
    """Return the longest of gap sizes [steps] that the rows around tell well enough; 0 where none is."""
    if len(t) < _N_TRIALS or not np.isfinite(x).all():
        return 0
    single, longest = _measure_miss(t, x, 2), 0
    for size in sizes:
        if len(t) < 4 * (size + 2 * _AROUND) or np.any(_measure_miss(t, x, size) > MAX_MISS * single):
            break
        longest = size
    return longest


def _measure_miss(t: NDArray[np.float64], x: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the median size (n,) by which splines miss rows (N, n) in the midst of those that a gap of `size` steps lacks."""
    row = np.concatenate([np.arange(1 - _AROUND, 1), np.arange(size, size + _AROUND)])
    middle = size // 2
    starts = np.linspace(_AROUND, len(t) - size - _AROUND, _N_TRIALS).astype(int)
    missed = [CubicSpline(t[i + row], x[i + row])(t[i + middle]) - x[i + middle] for i in starts]
    return np.median(np.abs(missed), axis=0)
