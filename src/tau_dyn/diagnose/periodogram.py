r"""Thousands of periods at once: how much a sine of the position explains, by fast Fourier transforms over the position.

The score of `exp(2 pi i q / P)` against white residual rows `L e` is a Fourier sum over positions of `u = L' e`, weighted by
what the low-pass leaves of the local frequency `f = |v| / P`. Samples are sorted into a few classes of speed, in which this
weight depends on P alone, and binned by position. The Gram matrix is that of a sine in noise of spectrum `1 / |L(f)|^2`: half
the sum of the weights squared. It leaves out what the baseline absorbs, which is little for short periods; what is
found is weighed again exactly. Reference: Scargle 1982.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import fft, sparse

from tau_dyn.estimate import Autoregression

_CLASSES = 10
_PER_PERIOD = 12
OVERSAMPLING = 4
"""Steps of the scan per 1 / range; `effects/periodic.py` lays its grid out alike."""


def explained_by_periods(
    q: np.ndarray,
    v: np.ndarray,
    u: np.ndarray,
    mask: np.ndarray,
    periods: np.ndarray,
    weight: Callable[[float, np.ndarray], np.ndarray],
    noise: Autoregression,
    rate_hz: float,
) -> np.ndarray:
    """Return `T` (g, d) of each period for each residual.

    Args:
        q: Positions of samples (n,) [m or rad].
        v: Speeds (n,).
        u: Residuals and noise draws, white rows carried back to samples (n, d).
        mask: Samples that count (n,).
        periods: Periods (g,) [m or rad].
        weight: Gives, for a speed and periods (g,), the size (g,) that a unit amplitude has in the filtered force.
        noise: Noise model of the output.
        rate_hz: Sampling rate of the rows [Hz].
    """
    lines = 1 / periods
    travel = float(np.ptp(q)) or 1.0
    size = int(2 ** np.ceil(np.log2(OVERSAMPLING * travel * _PER_PERIOD * lines.max())))
    bins = np.minimum(((q - q.min()) / (OVERSAMPLING * travel) * size).astype(int), size - 1)
    speed = np.abs(v)
    edges = np.quantile(speed[mask], np.linspace(0, 1, _CLASSES + 1)[1:-1])
    number = np.searchsorted(edges, speed)
    index = lines * OVERSAMPLING * travel
    S = np.zeros((len(lines), u.shape[1]), complex)
    G = np.zeros(len(lines))
    for c in range(_CLASSES):
        mine = np.flatnonzero((number == c) & mask)
        if not mine.size:
            continue
        typical = float(np.median(speed[mine]))
        size_here = weight(typical, periods)
        place = sparse.csr_matrix((np.ones(len(mine)), (bins[mine], np.arange(len(mine)))), shape=(size, len(mine)))
        spectrum = np.asarray(fft.rfft(np.ascontiguousarray((place @ u[mine]).T)))
        S += size_here[:, None] * _at(spectrum, index)
        G += 0.5 * size_here**2 * len(mine) * _whitened_power(noise, typical * lines / rate_hz)
    return np.abs(S) ** 2 / np.maximum(G, 1e-300)[:, None] * (G > 1e-9 * G.max(initial=0.0))[:, None]


def lowpassed(cutoff_hz: float) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the weight of a force: what the zero-phase low-pass leaves of its local frequency."""
    return lambda speed, periods: 1 / (1 + (speed / periods / cutoff_hz) ** 8)


def _at(spectrum: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return a spectrum (d, bins) at lines of the scan (g, d)."""
    return spectrum[:, np.minimum(np.round(index).astype(int), spectrum.shape[1] - 1)].T


def _whitened_power(noise: Autoregression, share: np.ndarray) -> np.ndarray:
    """Return `|L(f)|^2` at frequencies given as shares of the sampling rate."""
    p = len(noise.phi)
    response = np.ones(len(share), complex)
    for k in range(p):
        response -= noise.phi[k] * np.exp(-2j * np.pi * share * (k + 1))
    c = noise.autocovariance(p + 1)
    innovation = float(c[0] - sum(noise.phi[k] * c[k + 1] for k in range(p)))
    return np.abs(response) ** 2 / max(innovation, 1e-12 * float(c[0]))


def carried_back(rows: Sequence[sparse.csr_matrix], white: np.ndarray) -> list[np.ndarray]:
    """Return white rows (R, d) of one output carried back to the samples of each run (n, d)."""
    found, start = [], 0
    for L in rows:
        found.append(L.T @ white[start : start + L.shape[0]])
        start += L.shape[0]
    return found
