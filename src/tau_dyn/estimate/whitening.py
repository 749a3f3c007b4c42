r"""Coloured residuals made white: an autoregressive model's one-step predictors as sparse rows, gaps included.

Within each unbroken stretch of usable samples of one output, row t is

    (e_t - sum_k phi_k^(m) e_{t-k}) / sigma_m,   m = min(t - start, order),

with `phi^(m)` and `sigma_m` of the best predictor of order m (Levinson-Durbin), so that also the first samples of a
stretch are white and of unit variance: the exact likelihood of a stationary process in each stretch. Reference: Brockwell &
Davis 1991, 8.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import solve_toeplitz

from tau_dyn.estimate.autoregression import Autoregression
from tau_dyn.estimate.covariance import assign_blocks
from tau_dyn.estimate.regression import RegressionRun


@dataclass(frozen=True, eq=False)
class Whitener:
    """Turns arrays over runs into white rows.

    Attributes:
        rows: One sparse matrix (r, n) for each run and output, run by run.
        n_outputs: Outputs m.
        index: Output of each row (R,).
        block: Number of the 2 s block of each row (R,).
        t: Time of each row within its run (R,) [s].
    """

    rows: tuple[sparse.csr_matrix, ...]
    n_outputs: int
    index: np.ndarray
    block: np.ndarray
    t: np.ndarray

    @classmethod
    def of(
        cls, runs: Sequence[RegressionRun], masks: Sequence[np.ndarray], noise: Sequence[Autoregression]
    ) -> Whitener:
        """Prepare for runs, the samples that count (n, m) of each, and the noise model of each output."""
        predictors = [_predictors(model) for model in noise]
        rows, index, block, t, first = [], [], [], [], 0
        for run, mask in zip(runs, masks, strict=True):
            number = first + assign_blocks(run.t - run.t[0])
            first = int(number[-1]) + 1
            for k, predictor in enumerate(predictors):
                used = np.flatnonzero(mask[:, k])
                rows.append(_matrix(used, len(run.t), predictor))
                index.append(np.full(len(used), k))
                block.append(number[used])
                t.append(run.t[used])
        return cls(tuple(rows), len(predictors), np.concatenate(index), np.concatenate(block), np.concatenate(t))

    @property
    def n_rows(self) -> int:
        """Number of rows R."""
        return len(self.index)

    def __call__(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return white rows (R, ...) of arrays over the runs (n, m, ...); runs without any row are not looked at."""
        m = self.n_outputs
        parts = [L @ arrays[k // m][:, k % m] for k, L in enumerate(self.rows) if L.nnz]
        return np.concatenate(parts) if parts else np.zeros((0, *np.shape(arrays[0])[2:]))

    def one(self, output: int, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return the white rows of one output alone, of arrays over the runs (n, ...)."""
        return np.concatenate([self.rows[r * self.n_outputs + output] @ x for r, x in enumerate(arrays)])


def _predictors(model: Autoregression) -> list[np.ndarray]:
    """Return, for each order up to the model's, the row `[1, -phi_1, ..., -phi_m] / sigma_m`."""
    p = len(model.phi)
    c = model.autocovariance(p + 1) if p else np.array([model.variance])
    c = np.maximum(c[0], 1e-300) * (c / c[0] if c[0] > 0 else np.eye(1, p + 1)[0])
    found = [np.array([1.0]) / np.sqrt(c[0])]
    for m in range(1, p + 1):
        phi = np.asarray(solve_toeplitz(c[:m], c[1 : m + 1]))
        variance = max(float(c[0] - phi @ c[1 : m + 1]), 1e-12 * c[0])
        found.append(np.concatenate([[1.0], -phi]) / np.sqrt(variance))
    return found


def _matrix(used: np.ndarray, n: int, predictors: list[np.ndarray]) -> sparse.csr_matrix:
    """Return the rows (r, n) of the used samples."""
    fresh = np.concatenate([[True], np.diff(used) > 1]) if used.size else np.zeros(0, bool)
    start = np.maximum.accumulate(np.where(fresh, np.arange(len(used)), 0)) if used.size else np.zeros(0, int)
    depth = np.minimum(np.arange(len(used)) - start, len(predictors) - 1)
    rows, columns, values = [], [], []
    for m, predictor in enumerate(predictors):
        mine = np.flatnonzero(depth == m)
        for lag, value in enumerate(predictor):
            rows.append(mine)
            columns.append(used[mine] - lag)
            values.append(np.full(len(mine), value))
    triples = [np.concatenate(x) if x else np.zeros(0) for x in (values, rows, columns)]
    return sparse.csr_matrix((triples[0], (triples[1].astype(int), triples[2].astype(int))), shape=(len(used), n))
