"""Even stretches of a recording on disk: its clock is read once and cut at gaps; every window is then on an even clock.

The rules are those of `resample.py`: an even clock is left alone, one that is even but rounded is replaced, an uneven one
is interpolated by a cubic spline. Samples n steps away affect a spline by 0.27^n, so a window's own samples and 64 more on each
side give the numbers that the whole recording would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.log.log import Log
from tau_dyn.log.recording import Recording
from tau_dyn.log.resample import MAX_RELATIVE_JITTER, MIN_GAP_STEPS, MIN_SEGMENT_SAMPLES, interpolate, is_rounded
from tau_dyn.results import count

_STEPS = 2**20  # steps from which the usual one is taken, spread evenly
_INDEX = 4096  # the time of every n-th sample is kept
_AROUND = 64  # samples of a spline beyond its window


@dataclass(frozen=True, eq=False)
class EvenSegment:
    """A part of a recording without gaps, on an even clock, read in windows.

    Attributes:
        recording: The recording that it is part of.
        first: Its first sample in the recording.
        n_recorded: Its samples there.
        n_samples: Its samples on the even clock.
        t0: Time of the first one [s].
        dt: Time between samples [s].
        clock: `even`, `rounded` or `uneven`.
        index: Times of every 4096th recorded sample of the stretch (n,), for finding uneven ones.
        warnings: Sentences about doubts.
    """

    recording: Recording
    first: int
    n_recorded: int
    n_samples: int
    t0: float
    dt: float
    clock: str
    index: np.ndarray
    warnings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.dt

    def window(self, start: int, stop: int, wanted: tuple[str, ...]) -> Log:
        """Return the samples `start` to `stop - 1` of the wanted channels, on the even clock."""
        if self.clock != "uneven":
            log = self.recording.window(self.first + start, self.first + stop, wanted)
            return log if self.clock == "even" else Log(self._times(start, stop), log.channels, log.name)
        t = self._times(start, stop)
        low = _INDEX * max(0, int(np.searchsorted(self.index, t[0])) - 1) - _AROUND
        high = _INDEX * int(np.searchsorted(self.index, t[-1], "right")) + _AROUND
        low, high = max(0, low), min(self.n_recorded, high)
        log = self.recording.window(self.first + low, self.first + high, wanted)
        return Log(t, {key: interpolate(log.t, x, t) for key, x in log.channels.items()}, log.name)

    def survey(self, wanted: tuple[str, ...], most: int, count: int = 8) -> list[Log]:
        """Return the whole stretch if it has at most `most` samples, else `count` windows spread over it."""
        if self.n_samples <= most:
            return [self.window(0, self.n_samples, wanted)]
        size = most // count
        starts = np.linspace(0, self.n_samples - size, count).astype(int)
        return [self.window(int(s), int(s) + size, wanted) for s in starts]

    def _times(self, start: int, stop: int) -> np.ndarray:
        return self.t0 + self.dt * np.arange(start, stop)


@dataclass(frozen=True, eq=False)
class InMemorySegment:
    """An even stretch of a log in memory, with the interface of one on disk."""

    log: Log

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.log.name

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return self.log.n_samples

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        return self.log.rate_hz

    def window(self, start: int, stop: int, wanted: tuple[str, ...]) -> Log:
        """Return the samples `start` to `stop - 1`, all channels."""
        return self.log.window(start, stop)

    def survey(self, wanted: tuple[str, ...], most: int) -> list[Log]:
        """Return the whole log."""
        return [self.log]


def split_even_segments(recording: Recording) -> list[EvenSegment]:
    """Read a recording's clock and return its even stretches; those with fewer than 10 samples are left out.

    Raises:
        InputError: Time does not increase.
    """
    scan = _Scan(recording.n_samples)
    for _, t in recording.clock():
        scan.add(t)
    dt = float(np.median(np.concatenate(scan.steps)))
    odd_at, odd = np.concatenate(scan.odd_at), np.concatenate(scan.odd)  # far from usual: lost samples and gaps
    if scan.rounded and scan.lies_on_a_line():
        n = recording.n_samples
        said = (
            f"{recording.name}: its times are rounded; an even clock of {(n - 1) / scan.span:.6g} Hz was used instead."
        )
        return [EvenSegment(recording, 0, n, n, scan.t0, scan.span / (n - 1), "rounded", np.zeros(0), (said,))]
    gaps = odd > MIN_GAP_STEPS * dt
    ends = [0, *(int(i) for i in odd_at[gaps]), recording.n_samples]
    said = _gap_sentence(recording, odd_at[gaps], odd[gaps]) if gaps.any() else ()
    found = []
    for start, stop in zip(ends[:-1], ends[1:], strict=True):
        if stop - start >= MIN_SEGMENT_SAMPLES:
            inside = (odd_at > start) & (odd_at < stop)
            found.append(_stretch(recording, scan, start, stop, odd[inside], said))
    return found


def _stretch(
    recording: Recording, scan: _Scan, start: int, stop: int, odd: np.ndarray, said: tuple[str, ...]
) -> EvenSegment:
    t0, t1 = (float(recording.window(k, k + 2, ()).t[i]) for k, i in ((start, 0), (stop - 2, 1)))
    n_usual = stop - start - 1 - odd.size
    step = (
        (t1 - t0 - odd.sum()) / n_usual if n_usual else (t1 - t0) / odd.size
    )  # the mean of the usual ones, as `Log.dt`
    if not odd.size and scan.jitter(start, stop) <= MAX_RELATIVE_JITTER:
        return EvenSegment(recording, start, stop - start, stop - start, t0, step, "even", np.zeros(0), said)
    n = round((t1 - t0) / step)
    index = np.array([recording.window(k, k + 2, ()).t[0] for k in range(start, stop - 1, _INDEX)])
    uneven = (
        f"{recording.name}: its steps vary or samples are missing; all channels were interpolated onto an even clock."
    )
    return EvenSegment(recording, start, stop - start, n + 1, t0, (t1 - t0) / n, "uneven", index, (*said, uneven))


class _Scan:
    """Statistics of the steps from one pass over all times."""

    def __init__(self, n: int) -> None:
        self.stride = max(1, n // _STEPS)
        self.steps: list[np.ndarray] = []
        self.odd_at: list[np.ndarray] = [np.zeros(0, int)]
        self.odd: list[np.ndarray] = [np.zeros(0)]
        self.rounded = True
        self.t0, self.span, self._n = 0.0, 0.0, 0
        self._last, self._usual = np.nan, 0.0
        self._index: list[np.ndarray] = []
        self._jitter: list[tuple[int, int, float]] = []

    def add(self, t: np.ndarray) -> None:
        """Take in the next times."""
        if not self._n:
            self.t0, self._last = float(t[0]), np.nan
            self._usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        steps = np.diff(t, prepend=self._last)
        rows = self._n + np.arange(len(t))
        off = np.abs(steps / (self._usual or 1.0) - 1)
        odd = np.flatnonzero(off >= 0.5)
        self._jitter.append((self._n, self._n + len(t), float(np.max(off[off < 0.5], initial=0.0))))
        self.odd_at.append(rows[odd])
        self.odd.append(steps[odd])
        kept = (rows % self.stride == 0) & np.isfinite(steps)
        self.steps.append(steps[kept])
        few = slice(None, None, max(1, len(t) // 64))
        self._index.append(np.column_stack([rows[few], t[few]]))  # a slice would keep the whole array
        self.rounded = self.rounded and len(t) > 2 and is_rounded(t)
        self._last, self._n = float(t[-1]), self._n + len(t)
        self.span = self._last - self.t0

    def lies_on_a_line(self) -> bool:
        """Return whether times, sampled over the whole stretch, are on one straight line."""
        rows, t = np.concatenate(self._index).T
        return bool(np.max(np.abs(self.t0 + self.span / (self._n - 1) * rows - t)) <= 1.5 * self._usual)

    def jitter(self, start: int, stop: int) -> float:
        """Return the largest relative deviation of usual steps, in the parts that a stretch touches."""
        return max(x for a, b, x in self._jitter if a < stop and b > start)


def _gap_sentence(recording: Recording, at: np.ndarray, steps: np.ndarray) -> tuple[str, ...]:
    places = [f"{step:.3g} s before sample {row + 1}" for row, step in zip(at[:3], steps[:3], strict=True)]
    more = f" and {len(at) - 3} more" if len(at) > 3 else ""
    gaps = count(len(at), "gap")
    return (f"{recording.name} has {gaps} in time: {', '.join(places)}{more}; it is cut there, not bridged.",)
