r"""What least squares needs of any number of rows: for each output the triangular factor of its columns and measurements.

With `[W_k y_k] = Q_k R_k`, `R_k` (p + 1, p + 1) gives every weighted fit of these rows and every residual's size,
`|y_k - W_k theta| = |R_k [-theta; 1]|`, whatever the outputs' weights. Factors of blocks of rows are stacked and factored
again, so rows may come in any number and be forgotten. Unlike the normal equations this keeps all digits. Reference: Golub &
Van Loan 2013, 5.2 and 6.5 (updating); Demmel et al. 2012 (tall-skinny QR).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

_ROWS = 4096
"""Rows factored at once; more do not fit the processor's cache."""


@dataclass(frozen=True, eq=False)
class SufficientStatistics:
    """Rows of m outputs and p columns, summed up.

    Attributes:
        R: Triangular factors of `[W y]` (m, p + 1, p + 1).
        sums: Sums of the rows `[W y]` (m, p + 1).
        count: Number of rows (m,).
    """

    R: np.ndarray
    sums: np.ndarray
    count: np.ndarray

    @classmethod
    def zero(cls, n_outputs: int, n_columns: int) -> SufficientStatistics:
        """Return the totals of no rows."""
        k = n_columns + 1
        return cls(np.zeros((n_outputs, k, k)), np.zeros((n_outputs, k)), np.zeros(n_outputs, int))

    @classmethod
    def of(cls, W: np.ndarray, y: np.ndarray, usable: np.ndarray | None = None) -> SufficientStatistics:
        """Return the totals of columns (n, m, p) and measurements (n, m), of usable samples (n, m) where given."""
        n, m, p = W.shape
        found = cls.zero(m, p)
        for k in range(m):
            columns, measured = W[:, k].T, y[:, k]
            if usable is not None and not usable[:, k].all():
                columns, measured = columns[:, usable[:, k]], measured[usable[:, k]]
            found.R[k], found.sums[k] = (
                compute_triangular_factor(columns.T, measured),
                [*columns.sum(axis=1), measured.sum()],
            )
            found.count[k] = len(measured)
        return found

    def __add__(self, other: SufficientStatistics) -> SufficientStatistics:
        """Return the totals of these rows and others."""
        both = np.concatenate([self.R, other.R], axis=1)
        R = np.stack([_factor(np.asfortranarray(rows)) for rows in both]) if len(both) else self.R
        return SufficientStatistics(R, self.sums + other.sums, self.count + other.count)

    def scaled(self, factors: Sequence[float]) -> SufficientStatistics:
        """Return the totals with each output's measurements multiplied by a factor."""
        R, sums = self.R.copy(), self.sums.copy()
        R[:, :, -1] *= np.asarray(factors)[:, None]
        sums[:, -1] *= factors
        return SufficientStatistics(R, sums, self.count)

    def squares(self, theta: np.ndarray) -> np.ndarray:
        """Return the sum of squared residuals of each output (m,) at a parameter vector (p,)."""
        return np.sum((self.R[:, :, -1] - self.R[:, :, :-1] @ theta) ** 2, axis=1)

    def power(self) -> np.ndarray:
        """Return the sum of squared measurements of each output (m,)."""
        return np.sum(self.R[:, :, -1] ** 2, axis=1)


def compute_triangular_factor(W: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the triangular factor (p + 1, p + 1) of rows `[W y]`, W (n, p) and y (n,); columns of zeros cost nothing."""
    p = W.shape[1]
    used = np.flatnonzero(W.any(axis=0)) if len(W) else np.zeros(0, int)
    small = np.zeros((0, len(used) + 1))
    for start in range(0, len(y), _ROWS):
        part = slice(start, start + _ROWS)
        rows = np.empty(
            (len(used) + 1, len(small) + len(y[part]))
        )  # transposed: LAPACK takes columns one after another
        rows[:, : len(small)] = small.T
        rows[:-1, len(small) :] = W.T[:, part] if len(used) == p else W.T[used, part]
        rows[-1, len(small) :] = y[part]
        small = _factor(rows.T)
    out = np.zeros((p + 1, p + 1))
    place = [*used, p]
    out[np.ix_(place[: len(small)], place)] = small
    return out


def _factor(rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor (min(n, k), k) of rows (n, k) in Fortran order, which are overwritten."""
    factored, _, _, fault = lapack.dgeqrf(rows, overwrite_a=1)
    if fault:
        raise ValueError(f"dgeqrf: argument {-fault}")
    return np.triu(factored[: min(rows.shape)])
