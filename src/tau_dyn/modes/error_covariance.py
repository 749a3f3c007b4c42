r"""Covariance of an output-error estimate whose errors may be coloured.

    cov = H^-1 (sum_{t,s} J_t' W R_{t-s} W J_s) H^-1,    H = sum_t J_t' W J_t,

with R the autocovariance of the errors, from a vector autoregression fitted to the residuals; with white residuals it
is H^-1. The double sum is taken in the frequency domain, chunk by chunk. References: Ljung 1999, 9.4; Söderström &
Stoica 1989, (7.59).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.modes.arx import compute_spectrum, fit_autoregression
from tau_dyn.modes.basis import DerivativeMaps, build_columns, compute_derivative_maps
from tau_dyn.modes.gauss_newton import FitPoint, assemble_normal_equations
from tau_dyn.modes.modal_form import build_layout
from tau_dyn.modes.record import Record

FREQUENCIES = 512  # treated at once; bounds the memory
CHUNK = 16384  # errors further apart than a chunk count as independent


def estimate_error_covariance(
    point: FitPoint, records: Sequence[Record], free: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return the covariance of the model's free numbers (f, f) and the residuals record by record.

    Args:
        point: The minimum.
        records: Aligned and scaled.
        free: Which numbers of the model's full vector are free (size,).
    """
    weight = np.linalg.inv(point.covariance)
    root = np.linalg.cholesky((weight + weight.T) / 2).T
    normal = assemble_normal_equations(point, free, weight)
    inverse = _inverse(normal.H)
    errors = compute_residuals(point, records)
    coefficients, noise = fit_autoregression([e @ root.T for e in errors])
    n = normal.n_model
    if len(coefficients) == 0:
        return inverse[:n, :n], errors
    middle = _middle(point, records, root, coefficients, noise)[np.ix_(normal.free, normal.free)]
    return (inverse @ middle @ inverse)[:n, :n], errors


def compute_residuals(point: FitPoint, records: Sequence[Record]) -> tuple[np.ndarray, ...]:
    """Return measured minus modelled outputs, record by record."""
    out = []
    for record, x0 in zip(records, point.x0, strict=True):
        out.append(np.vstack([record.y[c.part] - c.predicted for c in build_columns(point.form, x0, record)]))
    return tuple(out)


def _middle(
    point: FitPoint, records: Sequence[Record], root: np.ndarray, coefficients: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """The double sum over the full vector and all records' initial states."""
    size, k = build_layout(point.form).size, len(point.form.poles)
    total = size + 2 * k * len(records)
    middle = np.zeros((total, total))
    for r, (record, x0) in enumerate(zip(records, point.x0, strict=True)):
        n = 1 << (2 * min(CHUNK, record.n_samples) - 1).bit_length()
        density = compute_spectrum(coefficients, noise, n)
        weight = np.where((np.arange(n // 2 + 1) == 0) | (2 * np.arange(n // 2 + 1) == n), 1.0, 2.0) / n
        weighted = (root.T @ density @ root) * weight[:, None, None]
        maps = compute_derivative_maps(point.form, x0)
        where = np.r_[np.arange(size), size + 2 * k * r + np.arange(2 * k)]
        inner = np.zeros((size + 2 * k, size + 2 * k))
        for columns in build_columns(point.form, x0, record, min(CHUNK, record.n_samples)):
            inner += _correlate(np.fft.rfft(columns.real, n, axis=0), weighted, maps)
        middle[np.ix_(where, where)] += inner
    return middle


def _correlate(columns: np.ndarray, weighted: np.ndarray, maps: DerivativeMaps) -> np.ndarray:
    """Return the sum over outputs o, o' and frequencies of J_o^H S_oo' J_o' (size, size), from columns (F, q) and S (F, p, p)."""
    out = np.zeros((maps.size, maps.size))
    own, (p, w) = maps.own.ravel(), maps.own.shape
    s = len(maps.shared)
    square, both, alone = np.zeros((s, s)), np.zeros((p, w, s)), np.zeros((p, w, p, w))
    for first in range(0, len(columns), FREQUENCIES):
        x, S = columns[first : first + FREQUENCIES], weighted[first : first + FREQUENCIES]
        moved = x[:, None, maps.re] * maps.real + x[:, None, maps.im] * maps.imaginary  # (F, p, s)
        passed = S @ moved
        square += (moved.reshape(-1, s).conj().T @ passed.reshape(-1, s)).real
        z = x @ maps.own_map
        both += (z.conj().T @ passed.reshape(len(x), -1)).real.reshape(w, p, s).swapaxes(0, 1)
        products = (z.conj()[:, :, None] * z[:, None, :]).reshape(len(x), -1)
        alone += (S.reshape(len(x), -1).T @ products).real.reshape(p, p, w, w).swapaxes(1, 2)
    flat = both.reshape(p * w, s)
    out[np.ix_(maps.shared, maps.shared)] = square
    out[np.ix_(own, maps.shared)], out[np.ix_(maps.shared, own)] = flat, flat.T
    out[np.ix_(own, own)] = alone.reshape(p * w, p * w)
    return (out + out.T) / 2


def _inverse(H: np.ndarray) -> np.ndarray:
    """Inverse of a Gauss-Newton matrix whose numbers have unlike units."""
    scale = np.sqrt(np.diag(H))
    scale[scale == 0] = 1.0
    return np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale)
