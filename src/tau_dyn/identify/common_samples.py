"""Copies by content: test whether two logs hold the same measured samples, for any clocks, rates and digits.

A robot that repeats a motion gives nearly the same positions and forces, so that similar signals prove little. Noise never
repeats: two logs hold the same samples if they share the *noise* of their forces. Three steps, the cheap ones first:

1. **Equal rows.** Rows of q and tau are hashed; consecutive rows that occur in the other log, in the same order and in equal
   steps, are the same samples. This finds excerpts, other clocks, joined files and rows left out, at any offset.
2. **Alignment** of the rest: blocks of the shorter log are looked up in the longer one by normalised cross-correlation (FFT)
   on a coarse grid; a Gauss-Newton step on the positions brings the offset to a small part of a sample.
3. **Comparison** at that offset, on the clock of the slower log: values equal to half a step of the coarser rounding, or
   shared noise. Both forces pass one whitening filter (autoregression). `r` is their correlation at the frequencies of the
   noise floor, in the quieter half of short windows. A floor has to be flat and even in time, as noise is; gear ripple and
   reversals, which a motion repeats, are not. Independent noise has r = 0, a copy with added noise n times its own has
   `r = 1 / sqrt(1 + n^2)`. A repeated motion also leaves a slow difference of the forces (friction, temperature, tracking);
   added noise and rounding leave a white one, resampling one that grows with frequency and needs no floor.

If the forces show no noise floor (10 Hz, gear ripple far above the noise), a re-noised copy is not detected.
Scales, signs and offsets of columns are free in 2 and in the shared noise of 3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter, periodogram
from scipy.signal.windows import hann
from scipy.stats import chi2, norm

from tau_dyn.log import Log, Recording, compute_edge_samples, estimate_quantisation_step, lowpass

Array = NDArray[np.float64]

MIN_COMMON_ROWS = 50
"""Changing rows in a sequence that make two logs copies of each other, and the fewest samples that a comparison takes."""

EQUAL_SHARE = 0.999
"""Share of samples that are equal to within rounding in a copy; rounding errors at ties are rarer than 1 in 1000."""

MIN_SHARED_NOISE = 0.7
"""Correlation of two noise floors above which the noise is shared: a copy with added noise as large as its own has 0.71."""

LEVEL = 1e-4
"""Probability that noise with a correlation of `MIN_SHARED_NOISE` exceeds it by chance, at all offsets of two logs together."""

MAX_SLOW_EXCESS = 3.0
"""Power density of the forces' difference at the motion's frequencies over that at high ones; 1 for added white noise.

A mean over 32 bins of white noise exceeds 3 with a probability below 1e-9."""

RESAMPLING_EXCESS = 0.1
"""The same density ratio below which a difference is an interpolation error, which grows with frequency; noise does not."""

FLOOR_RATIO = 4.0
"""Density of a noise floor over its least value: white noise and a first-order low-pass to twice its corner."""

MIN_FLOOR_SHARE = 0.4
"""Share of the frequencies below 0.4 of the sampling rate at which a force has to be at its floor; the motion has the rest."""

MAX_UNEVENNESS = 1.6
"""Median over 10 % quantile of the floor's energy in short windows, over the same ratio of white noise.

Noise is even in time; gear ripple and reversals, which a motion repeats, vary with the speed."""

MIN_FLOOR_WINDOWS = 30
"""Windows from which these two ratios are known to about a fifth."""

MIN_ALIKE = 0.98
"""Correlation of the positions at an offset worth comparing; noise of a fifth of the motion's amplitude gives 0.98."""

_GRID_SAMPLES = 2**16  # of the coarse grid of the alignment, at most
_COMPARED_SAMPLES = 2**16  # at most
_BLOCKS = 8  # of the shorter log, each looked up alone, so that logs may overlap in part
_OFFSETS = 8  # that are compared, at most
_ORDER = 12  # of the whitening autoregression
_WINDOW = 32  # samples of the windows of a noise floor
_MIN_WINDOWS = 4  # of a comparison that needs no floor


def has_common_samples(one: Log | Recording, other: Log | Recording) -> bool:
    """Return whether two logs hold the same samples; parts of one file that do not overlap in time are different data.

    Recordings on disk are compared by their files' hashes, logs in memory by their content.
    """
    if one is other:
        return True
    same_file = bool(one.sha256) and one.sha256 == other.sha256
    if isinstance(one, Recording) or isinstance(other, Recording):
        return same_file
    if same_file:
        return bool(one.t[0] <= other.t[-1] and other.t[0] <= one.t[-1])
    names = _list_compared(one, other)
    if not any(name.startswith("q_") for name in names) or all(name.startswith("q_") for name in names):
        return False
    short, long = sorted((one, other), key=lambda log: log.n_samples)
    return _has_equal_rows(_hash_rows(short, names), _hash_rows(long, names)) or _shares_noise(one, other, names)


def _list_compared(one: Log, other: Log) -> list[str]:
    """Return the positions and forces that both logs have; without forces, all channels of both."""
    both = [
        name
        for name, values in one.channels.items()
        if name in other.channels and np.isfinite(values).all() and np.isfinite(other.channels[name]).all()
    ]
    used = [name for name in both if name.startswith(("q_", "tau_")) and not name.startswith("q_ref_")]
    return used if any(name.startswith("tau_") for name in used) else both


def _hash_rows(log: Log, names: list[str]) -> NDArray[np.uint64]:
    """Return a number per row that differs from the row before it (n,); two rows in 2^64 have the same one by chance."""
    total = np.zeros(log.n_samples, np.uint64)
    for name in names:
        total ^= (log.channels[name] + 0.0).view(np.uint64)  # -0 is 0
        total *= np.uint64(0x9E3779B97F4A7C15)
        total ^= total >> np.uint64(29)
    return total[np.r_[True, total[1:] != total[:-1]]]


def _has_equal_rows(wanted: NDArray[np.uint64], held: NDArray[np.uint64]) -> bool:
    """Return whether consecutive rows, by their hashes (n,), occur in a longer log (N,) in equal steps."""
    order = np.argsort(held)
    values = held[order]
    first = np.searchsorted(values, wanted)
    place = np.minimum(first, len(values) - 1)
    after = values[np.minimum(first + 1, len(values) - 1)]
    found = (values[place] == wanted) & ((after != wanted) | (first + 1 >= len(values)))
    steps = np.diff(np.where(found, order[place], -1))
    sound = found[1:] & found[:-1] & (steps > 0)
    in_step = sound[1:] & sound[:-1] & (steps[1:] == steps[:-1])
    return _longest_run(in_step) >= MIN_COMMON_ROWS - 2


def _longest_run(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0]))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


@dataclass(frozen=True, eq=False)
class _Signals:
    """Clock (N,) [s], positions and forces (each (N,)) of a log."""

    t: Array
    q: tuple[Array, ...]
    tau: tuple[Array, ...]

    @property
    def dt(self) -> float:
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    def read(self, t: Array) -> Array:
        """Return all signals (n, nq + nf) at times (n,) by linear interpolation."""
        return np.column_stack([np.interp(t, self.t, x) for x in (*self.q, *self.tau)])

    def cut(self, begin: float, end: float) -> _Signals:
        """Return the samples between two times [s]."""
        rows = slice(np.searchsorted(self.t, begin), np.searchsorted(self.t, end, "right"))
        return _Signals(self.t[rows], tuple(x[rows] for x in self.q), tuple(x[rows] for x in self.tau))

    def smooth(self, dt: float) -> _Signals:
        """Return the signals low-passed for samples of another step, as decimation does."""
        rate, cutoff = 1.0 / self.dt, 0.4 / dt
        if len(self.t) <= 2 * compute_edge_samples(cutoff, rate):
            return self
        q, tau = (tuple(lowpass(np.column_stack(x), cutoff, rate).T) for x in (self.q, self.tau))
        return _Signals(self.t, q, tau)


def _shares_noise(one: Log, other: Log, names: list[str]) -> bool:
    """Return whether two logs in memory share force noise at one of the offsets at which their positions agree."""
    forces = [name for name in names if name.startswith("tau_")]
    if not forces or min(one.n_samples, other.n_samples) < MIN_COMMON_ROWS:
        return False
    positions = [name for name in names if name.startswith("q_")]
    for clocks in _list_clocks(one, other):
        logs = [
            _Signals(t, tuple(log.channels[x] for x in positions), tuple(log.channels[x] for x in forces))
            for t, log in zip(clocks, (one, other), strict=True)
        ]
        slow, fast = sorted(logs, key=lambda signals: -signals.dt)
        if any(_agrees(slow, fast, *found) for found in _find_offsets(slow, fast)):
            return True
    return False


def _list_clocks(one: Log, other: Log) -> Iterator[tuple[Array, Array]]:
    """Yield the recorded clocks (each from 0) and, if their rates differ, the clocks of logs that match row by row."""
    yield one.t - one.t[0], other.t - other.t[0]
    if abs(one.dt / other.dt - 1.0) > 1e-4:
        rows, others = (np.arange(log.n_samples, dtype=np.float64) for log in (one, other))
        yield np.asarray(one.dt * rows, np.float64), np.asarray(one.dt * others, np.float64)


def _find_offsets(slow: _Signals, fast: _Signals) -> Iterator[tuple[float, float, float]]:
    """Yield offsets [s] at which the positions agree, `t_fast = t_slow + offset`, each with its block of the slow log [s]."""
    step = max(slow.dt, max(slow.t[-1], fast.t[-1]) / _GRID_SAMPLES)
    grids = [x.read(np.arange(0.0, x.t[-1], step)) for x in (slow, fast)]
    turned = len(grids[1]) < len(grids[0])
    short, long = (x / np.maximum(np.std(x, axis=0), 1e-300) for x in (grids[::-1] if turned else grids))
    found = []
    for start, stop in _split_blocks(len(short)):
        for place, score in _look_up(short[start:stop], long, len(slow.q)):
            lag = (place - start) * step
            found.append((score, -lag if turned else lag, (place if turned else start) * step, (stop - start) * step))
    kept: list[tuple[float, float]] = []
    for _, lag, begin, length in sorted(found, reverse=True):
        if all(abs(lag - other) > step for other, _ in kept) and len(kept) < _OFFSETS:
            kept.append((lag, begin))
            yield lag, begin, begin + length


def _split_blocks(n: int) -> list[tuple[int, int]]:
    """Return first and last sample of the blocks that are looked up."""
    length = max(n // _BLOCKS, min(n, MIN_COMMON_ROWS))
    return [(start, start + length) for start in range(0, n - length + 1, length)]


def _look_up(block: Array, long: Array, nq: int) -> list[tuple[int, float]]:
    """Return the best places of a block (n, c) in a log (N, c), by normalised cross-correlation, with their scores."""
    n, m = len(block), len(long)
    centred = block - block.mean(axis=0)
    size, weight = np.linalg.norm(centred, axis=0), np.std(block, axis=0)
    if weight[:nq].sum() <= 1e-3:
        return []
    length = next_fast_len(m + n, real=True)
    spectrum = np.fft.rfft(long, length, axis=0) * np.conj(np.fft.rfft(centred, length, axis=0))
    product = np.fft.irfft(spectrum, length, axis=0)[: m - n + 1]
    sums = [np.vstack([np.zeros(long.shape[1]), np.cumsum(x, axis=0)]) for x in (long, long**2)]
    first, second = (s[n:] - s[:-n] for s in sums)
    spread = np.sqrt(np.maximum(second - first**2 / n, 1e-9 * n))
    alike = np.abs(product) / (spread * np.maximum(size, 1e-300))
    of_positions = alike[:, :nq] @ weight[:nq] / weight[:nq].sum()
    score = of_positions + alike[:, nq:].mean(axis=1)
    peak = np.r_[True, score[1:] >= score[:-1]] & np.r_[score[:-1] > score[1:], True] & (of_positions > MIN_ALIKE)
    places = np.flatnonzero(peak)
    best = places[np.argsort(-score[places])][:_OFFSETS]
    return [(int(place), float(score[place])) for place in best]


def _agrees(slow: _Signals, fast: _Signals, offset: float, begin: float, end: float) -> bool:
    """Return whether the logs are copies at an offset [s], over their whole overlap or in the block that led to it."""
    first, last = max(0.0, -offset), min(slow.t[-1], fast.t[-1] - offset)
    middle, half = (begin + end) / 2, _COMPARED_SAMPLES * slow.dt / 2
    parts = [(max(first, middle - half), min(last, middle + half)), (max(first, begin), min(last, end))]
    return any(_agrees_within(slow.cut(*part), fast, offset) for part in parts)


def _agrees_within(slow: _Signals, fast: _Signals, offset: float) -> bool:
    """Return whether a part of the slow log is a copy of the fast one near an offset [s]."""
    if len(slow.t) < MIN_COMMON_ROWS:
        return False
    fine = _refine_offset(slow, fast, offset)
    near = fast.cut(slow.t[0] + fine - slow.dt, slow.t[-1] + fine + slow.dt)
    if len(near.t) < MIN_COMMON_ROWS:
        return False
    shifts = (fine, round(fine / fast.dt) * fast.dt)  # the second is exact for a copy on the same clock
    if any(_is_rounded(slow, near.read(slow.t + shift)) for shift in shifts):
        return True
    variants = [near, near.smooth(slow.dt)] if slow.dt > 1.3 * fast.dt else [near]
    forces = (x.read(slow.t + shift)[:, len(slow.q) :] for x in variants for shift in shifts)
    return any(_share_noise(np.column_stack(slow.tau), theirs) for theirs in forces)


def _refine_offset(part: _Signals, fast: _Signals, offset: float) -> float:
    """Return the offset [s] at which positions fit best, up to a scale and an offset per joint (Gauss-Newton)."""
    every = max(1, len(part.t) // 4096)
    t = part.t[::every]
    for _ in range(6):
        top = bottom = 0.0
        for ours, theirs in zip(part.q, fast.q, strict=True):
            column = ours[::every]
            there, ahead, behind = (np.interp(t + offset + d, fast.t, theirs) for d in (0.0, part.dt, -part.dt))
            speed = (ahead - behind) / (2 * part.dt)
            columns = np.column_stack([there - there.mean(), speed, np.ones(len(t))])
            gain, shift, _ = np.linalg.lstsq(columns, column, 1e-9)[0]
            weight = np.var(speed) / max(np.var(column), 1e-300)
            top, bottom = top + gain * shift * weight, bottom + gain**2 * weight
        if not bottom > 0.0:
            break
        offset += top / bottom
    return offset


def _is_rounded(ours: _Signals, theirs: Array) -> bool:
    """Return whether all signals (n, nq + nf) are equal to half a step of the coarser rounding, with forces that change."""
    mine = np.column_stack([*ours.q, *ours.tau])
    step = np.maximum(estimate_quantisation_step(mine), estimate_quantisation_step(theirs))
    near = np.abs(mine - theirs) <= 0.5001 * step + 1e-9 * np.abs(mine).max(axis=0)
    changes = max(np.count_nonzero(np.diff(x)) for x in ours.tau)
    return bool(changes >= MIN_COMMON_ROWS and np.mean(near.all(axis=1)) >= EQUAL_SHARE)


def _share_noise(ours: Array, theirs: Array) -> bool:
    """Return whether forces (n, c) share noise, and differ by no slow motion."""
    excess = measure_slow_excess(ours, theirs)
    resampled = bool(np.all(excess <= RESAMPLING_EXCESS))
    if not resampled and np.any(excess > MAX_SLOW_EXCESS):
        return False
    return measure_shared_noise(ours, theirs, needs_floor=not resampled) > MIN_SHARED_NOISE


def measure_shared_noise(ours: Array, theirs: Array, *, needs_floor: bool = True) -> float:
    """Return the lower limit at `LEVEL` of the correlation of the noise floors of forces (n, c), pooled over the columns.

    Columns without a noise floor of their own do not count unless `needs_floor` is false; without any, 0.
    """
    found = [
        _correlate_floors(mine, other, needs_floor)
        for mine, other in zip(ours.T, theirs.T, strict=True)
        if np.std(mine) > 0.0 and np.std(other) > 0.0
    ]
    products, total = sum(product for product, _ in found), sum(count for _, count in found)
    if not total:
        return 0.0
    z = np.arctanh(min(products / total, 1.0 - 1e-12))
    return float(np.tanh(z + norm.ppf(LEVEL / _OFFSETS) / np.sqrt(total)))


def _correlate_floors(mine: Array, other: Array, needs_floor: bool) -> tuple[float, int]:
    """Return the sum of correlations of two signals' floors (n,) over windows and frequencies, and their number."""
    if len(mine) < (MIN_FLOOR_WINDOWS if needs_floor else _MIN_WINDOWS) * _WINDOW + _ORDER:
        return 0.0, 0
    taps = _fit_whitening(mine)
    first, second = (_take_spectra(np.asarray(lfilter(taps, [1.0], x - x.mean()))[_ORDER:]) for x in (mine, other))
    floor, flat = _find_floor(np.median(np.abs(first) ** 2, axis=0) / np.abs(np.fft.rfft(taps, _WINDOW)) ** 2)
    first, second = first[:, floor], second[:, floor]
    energy = np.mean(np.abs(first) ** 2, axis=1)
    if needs_floor and not (flat and _is_even(energy, 2 * int(floor.sum()))):
        return 0.0, 0
    product = np.sum(np.real(first * np.conj(second)), axis=1)
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    quiet = (energy <= np.median(energy)) & (size > 0.0)
    n = int(floor.sum())
    return n * abs(float(np.sum(product[quiet] / size[quiet]))), n * int(quiet.sum())


def _find_floor(density: Array) -> tuple[NDArray[np.bool_], bool]:
    """Return the bins (m,) of a density at its floor, and whether they are enough for a floor; resampling acts above 0.4."""
    f = np.fft.rfftfreq(_WINDOW)
    inside = (f > 0.05) & (f < 0.4)
    floor = inside & (density <= FLOOR_RATIO * density[inside].min())
    return floor, bool(floor.sum() >= MIN_FLOOR_SHARE * inside.sum())


def _is_even(energy: Array, freedoms: int) -> bool:
    """Return whether energies (m,) of windows vary little more than those of white noise, with so many degrees of freedom."""
    low, middle = np.quantile(energy, (0.1, 0.5))
    expected = chi2.ppf(0.5, freedoms) / chi2.ppf(0.1, freedoms)
    return bool(low > 0.0 and middle / low <= MAX_UNEVENNESS * expected)


def _take_spectra(x: Array) -> NDArray[np.complex128]:
    """Return the spectra (m, bins) of windows of a signal (n,)."""
    n = len(x) // _WINDOW
    windows = x[: n * _WINDOW].reshape(n, _WINDOW)
    return np.fft.rfft((windows - windows.mean(axis=1, keepdims=True)) * hann(_WINDOW), axis=1)


def _fit_whitening(x: Array) -> Array:
    """Return the filter (order + 1,) that whitens a signal (n,): an autoregression by Yule and Walker."""
    centred = x - x.mean()
    size = next_fast_len(2 * len(x), real=True)
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    lags = np.fft.irfft(power, size)[: _ORDER + 1]
    lags[0] *= 1.0 + 1e-9
    return np.asarray(np.append(1.0, -solve_toeplitz(lags[:-1], lags[1:])), dtype=np.float64)


def measure_slow_excess(ours: Array, theirs: Array) -> Array:
    """Return the power density of the difference of forces (n, c) at the motion's frequencies, over that at high ones (c,).

    The difference is taken after a scale and an offset per column. The motion's frequencies hold 90 % of the force's power.
    """
    found = []
    for mine, other in zip(ours.T, theirs.T, strict=True):
        a, b = mine - mine.mean(), other - other.mean()
        f, own = periodogram(a, window="blackmanharris")
        rest = periodogram(a - b * (a @ b) / max(b @ b, 1e-300), window="hann")[1]
        edge = f[np.searchsorted(np.cumsum(own), 0.9 * own.sum())]
        slow = (f > 0.0) & (f <= max(edge, f[min(32, len(f) // 4)]))
        found.append(np.mean(rest[slow]) / max(np.mean(rest[f > 0.25]), 1e-300))
    return np.array(found, dtype=np.float64)
