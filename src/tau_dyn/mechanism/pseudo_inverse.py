"""Inverses of constraint Jacobians, one or many; where there is none, the pseudo-inverse with unit columns.

Columns are scaled to length one first, since angles and lengths stand side by side. Reference: Golub & Van Loan 2013, ch. 5.5.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetri

ILL = 1e8
"""Conditioning above which an inverse comes from singular values."""
_ROUNDING = 1e-10
"""Singular values and columns smaller than this beside the largest are rounding."""


def invert_matrix(J: np.ndarray) -> np.ndarray:
    """Return the inverse (n, m) of a matrix (m, n) by LU; of one that is singular or not square, the pseudo-inverse."""
    if J.shape[0] == J.shape[1]:
        lu, pivots, fault = dgetrf(J)
        if fault == 0:
            found = dgetri(lu, pivots)[0]
            if np.abs(J).sum(axis=0).max() * np.abs(found).sum(axis=0).max() < ILL:
                return found
    lengths = measure_column_lengths(J)
    u, s, vt = np.linalg.svd(J / lengths, full_matrices=False)
    keep = s > _ROUNDING * s[0]  # a rod's free spin has no influence on anything we report: least norm
    return (vt[keep].T / s[keep]) @ u[:, keep].T / lengths[:, None]


def invert_matrices(J: np.ndarray) -> np.ndarray:
    """Return inverses (N, n, m) of matrices (N, m, n); of one that is singular or not square, the pseudo-inverse.

    Pseudo-inverses are those of unit columns, as of `invert_matrix`.
    """
    if J.shape[1] != J.shape[2]:
        return _pseudo_inverses(J)
    try:
        out = np.linalg.inv(J)
    except np.linalg.LinAlgError:
        return _pseudo_inverses(J)
    with np.errstate(all="ignore"):
        size = np.abs(J).sum(axis=1).max(axis=1) * np.abs(out).sum(axis=1).max(axis=1)
    ill = ~(size < ILL)
    if ill.any():
        out[ill] = _pseudo_inverses(J[ill])
    return out


def _pseudo_inverses(J: np.ndarray) -> np.ndarray:
    out = np.full((len(J), J.shape[2], J.shape[1]), np.nan)
    sound = np.isfinite(J).all(axis=(1, 2))
    out[sound] = _sound_pseudo_inverses(J[sound])
    return out


def _sound_pseudo_inverses(J: np.ndarray) -> np.ndarray:
    lengths = measure_column_lengths(J)
    u, s, vt = np.linalg.svd(J / lengths[:, None, :], full_matrices=False)
    kept = s > _ROUNDING * s[:, :1]  # a rod's free spin has no influence on anything we report: least norm
    weight = np.divide(1.0, s, out=np.zeros_like(s), where=kept)
    return (vt.transpose(0, 2, 1) * weight[:, None, :]) @ u.transpose(0, 2, 1) / lengths[:, :, None]


def measure_column_lengths(J: np.ndarray) -> np.ndarray:
    """Return the columns' lengths (..., n) of matrices (..., m, n), 1 for those that are zero but for rounding."""
    lengths = np.linalg.norm(J, axis=-2)
    return np.where(lengths > _ROUNDING * lengths.max(axis=-1, keepdims=True, initial=0.0), lengths, 1.0)


def measure_rank_distance(matrices: np.ndarray) -> np.ndarray:
    """Return the smallest singular value by the largest (N,); nan where a matrix is not finite."""
    out = np.full(len(matrices), np.nan)
    sound = np.isfinite(matrices).all(axis=(1, 2))
    if sound.any():
        s = np.linalg.svd(matrices[sound], compute_uv=False)
        out[sound] = s[:, -1] / s[:, 0]
    return out
