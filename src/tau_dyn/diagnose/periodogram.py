r"""Thousands of periods at once: how much a sine of the position explains, by fast Fourier transforms over the position.

The score of `exp(2 pi i q / P)` against white residual rows `L e` is a Fourier sum over positions of `u = L' e`, weighted by
what a unit amplitude becomes at the local frequency `f = |v| / P`. Samples are sorted into a few classes of speed, in which
this weight depends on P alone, and binned by position. What noise makes of each period, which the score is measured against,
is seen from the noise draws, put through the same sums; so what the baseline absorbs and what the noise model whitens are both
counted. What is found is weighed again exactly. Reference: Scargle 1982.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import fft, ndimage, sparse

_CLASSES = 8
_PER_PERIOD = 12
_SMOOTHED = 9
OVERSAMPLING = 4
"""Steps of the scan per 1 / range; `effects/periodic.py` lays its grid out alike."""

Weight = Callable[[float, np.ndarray], np.ndarray]
"""Gives, for a speed and periods (g,), the size (g,) that a unit amplitude has in the filtered force."""


def explained_by_periods(
    q: np.ndarray, v: np.ndarray, u: np.ndarray, mask: np.ndarray, periods: np.ndarray, weight: Weight
) -> np.ndarray:
    """Return `T` (g, d) of each period for each residual.

    Args:
        q: Positions of samples (n,) [m or rad].
        v: Speeds (n,).
        u: White rows carried back to samples (n, d): the residual first, then noise draws.
        mask: Samples that count (n,).
        periods: Periods (g,) [m or rad].
        weight: See `Weight`.
    """
    if not mask.any():
        return np.zeros((len(periods), u.shape[1]))
    lines = 1 / periods
    travel = float(np.ptp(q)) or 1.0
    size = int(2 ** np.ceil(np.log2(OVERSAMPLING * travel * _PER_PERIOD * lines.max())))
    bins = np.minimum(((q - q.min()) / (OVERSAMPLING * travel) * size).astype(int), size - 1)
    index = np.minimum(np.round(lines * OVERSAMPLING * travel).astype(int), size // 2)
    speed = np.abs(v)
    edges = np.quantile(speed[mask], np.linspace(0, 1, _CLASSES + 1)[1:-1])
    number = np.searchsorted(edges, speed)
    S = np.zeros((u.shape[1], len(lines)), complex)
    for c in range(_CLASSES):
        mine = np.flatnonzero((number == c) & mask)
        if mine.size:
            place = sparse.csr_matrix((np.ones(len(mine)), (bins[mine], np.arange(len(mine)))), shape=(size, len(mine)))
            spectrum = np.asarray(fft.rfft(np.ascontiguousarray((place @ u[mine]).T)))
            S += weight(float(np.median(speed[mine])), periods) * spectrum[:, index]
    power = np.abs(S) ** 2
    noise = ndimage.uniform_filter1d(power[1:].mean(axis=0), min(_SMOOTHED, len(lines)), mode="nearest") / 2
    return np.divide(power, noise, out=np.zeros_like(power), where=noise > 1e-9 * noise.max(initial=1e-300)).T


def lowpassed(cutoff_hz: float) -> Weight:
    """Return the weight of a force: what the zero-phase low-pass leaves of its local frequency."""
    return lambda speed, periods: 1 / (1 + (speed / periods / cutoff_hz) ** 8)


def accelerated(cutoff_hz: float) -> Weight:
    """Return the weight of a displacement: its acceleration at the local frequency, low-passed alike."""
    plain = lowpassed(cutoff_hz)
    return lambda speed, periods: plain(speed, periods) * (2 * np.pi * speed / periods) ** 2


def carried_back(rows: Sequence[sparse.csr_matrix], white: np.ndarray) -> list[np.ndarray]:
    """Return white rows (R, d) of one output carried back to the samples of each run (n, d)."""
    borders = np.cumsum([0, *(len(L.indptr) - 1 for L in rows)])
    return [L.T @ white[a:b] for L, a, b in zip(rows, borders[:-1], borders[1:], strict=True)]
