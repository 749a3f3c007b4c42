r"""Periodogram over the position: the statistic of each period of a cyclic error in a white residual.

Thousands of periods are tried at once by Fourier transforms over the position (Scargle 1982). The score of `exp(i w q)`,
`w = 2 pi / P`, against white residual rows `L e` is a Fourier sum over positions of `u = L' e`, weighted by the low-pass' gain
at the local frequency `f = |v| / P`. Samples are sorted into a few classes of speed, in which this weight depends on P alone,
and binned by position. A displacement acts by its acceleration, `(i w a - w^2 v^2) exp(i w q)`: two such sums. The distribution
under noise follows from noise draws with the same sums. The periods found are scored again exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import fft, ndimage, sparse

from tau_dyn.effects import Effect
from tau_dyn.estimate import Whitener
from tau_dyn.log import compute_attenuation

_CLASSES = 8  # of speed, each with as many samples
_PER_PERIOD = 12  # position bins per period of the shortest wave
_SMOOTHED = 9  # lines of the spectrum averaged for the noise next to a peak
OVERSAMPLING = 4
"""Steps of the scan per 1 / range; `effects/periodic.py` uses the same grid."""
LONG_PERIODS = 8.0
"""Number of periods in the range up to which a period is not scanned but tested exactly: there the acceleration matters as well
as the speed."""
Term = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]
"""A factor of each sample (n,), and its complex size (g,) at angular frequencies w (g,) over the position."""


def compute_period_statistics(
    q: np.ndarray,
    v: np.ndarray,
    u: np.ndarray,
    mask: np.ndarray,
    periods: np.ndarray,
    cutoff_hz: float,
    terms: Sequence[Term],
) -> np.ndarray:
    """Return the statistic `T` (g, d) of each period for each residual.

    Args:
        q: Positions of samples (n,) [m or rad].
        v: Speeds (n,).
        u: White rows carried back to samples (n, d): the residual first, then noise draws.
        mask: Samples that are used (n,).
        periods: Periods (g,) [m or rad].
        cutoff_hz: The zero-phase low-pass that both sides pass [Hz].
        terms: The signal of a unit amplitude before it; see `build_force_terms` and `build_displacement_terms`.
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
            passed = 1 / compute_attenuation(float(np.median(speed[mine])) * lines, cutoff_hz)
            for factor, size_of in terms:
                spectrum = np.asarray(fft.rfft(_sum_into_bins(bins[mine], factor[mine, None] * u[mine], size)))
                S += passed * size_of(2 * np.pi * lines) * np.conj(spectrum[:, index])
    power = np.abs(S) ** 2
    noise = ndimage.uniform_filter1d(power[1:].mean(axis=0), min(_SMOOTHED, len(lines)), mode="nearest") / 2
    return np.divide(power, noise, out=np.zeros_like(power), where=noise > 1e-9 * noise.max(initial=1e-300)).T


def _sum_into_bins(bins: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    """Return the sums (d, size) of samples' values (n, d) in each bin; a transform along the last axis is the fastest."""
    order = np.argsort(bins, kind="stable")
    place, first = np.unique(bins[order], return_index=True)
    sums = np.zeros((values.shape[1], size))
    sums[:, place] = np.add.reduceat(values[order], first, axis=0).T
    return sums


def build_force_terms(q: np.ndarray) -> list[Term]:
    """Return the single term of a position-dependent force."""
    return [(np.ones(len(q)), np.ones_like)]


def build_displacement_terms(v: np.ndarray, a: np.ndarray) -> list[Term]:
    """Return the terms of a displacement's acceleration along speeds and accelerations (n,)."""
    return [(a, lambda w: 1j * w), (v**2, lambda w: -(w**2))]


def scan_periods(
    effects: Sequence[Effect],
    whiten: Whitener,
    joint: int,
    white: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    cutoff_hz: float,
    terms: Sequence[Term] | None = None,
    scale: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the statistics (g, d) of periods of one joint's effects on white residuals (R, d).

    The joint has positions `q` (n,) [m or rad] and speeds `v` (n,); a unit amplitude is `terms`, by default a
    position-dependent force, times a factor `scale` (n, 1).
    """
    u, mask = select_output_rows(whiten, joint, white)
    periods = np.array([effect.settings["period"] for effect in effects])
    return compute_period_statistics(q, v, u * scale, mask, periods, cutoff_hz, terms or build_force_terms(q))


def select_output_rows(whiten: Whitener, output: int, white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return white rows (R, d) of all outputs as samples (n, d) of one of them, and the mask (n,) of its samples in rows."""
    rows = whiten.rows[output :: whiten.n_outputs]
    u = np.concatenate(project_to_samples(rows, white[np.flatnonzero(whiten.index == output)]))
    return u, np.concatenate([np.asarray(abs(L).sum(axis=0)).ravel() > 0 for L in rows])


def project_to_samples(rows: Sequence[sparse.csr_matrix], white: np.ndarray) -> list[np.ndarray]:
    """Return white rows (R, d) of one output carried back to the samples of each run (n, d)."""
    borders = np.cumsum([0, *(len(L.indptr) - 1 for L in rows)])
    return [L.T @ white[a:b] for L, a, b in zip(rows, borders[:-1], borders[1:], strict=True)]
