"""Covariance of an estimate with a coloured residual, and whitening of coloured residuals.

**Least squares.** With `W = U R` the weighted rows, `U` orthonormal, `cov = R^-1 (U' Omega U) R^-T`. `U' Omega U` is computed
twice: with `Omega` the autocovariance of an autoregressive model of each output's residual at true time lags, gaps in the mask
included; and from the scatter of 2 s blocks' scores, which also contains colour that no such model describes. For each
requested quantity the larger standard error counts. The matrices themselves are kept separate, as inflating one parameter by
parameter would destroy the correlations that determine sums (and, in `physical_consistency.py`, move an estimate in directions
that the data forbid). The point estimate stays that of weighted least squares: whitening would amplify the model error at high
frequency (on EMPS it moves the viscous coefficient by 4 %). Reference: White 1980; Newey & West 1987; Ljung 1999, 9.

**White equations** (`cov = J^-1 (K + sum g g') J^-T`). `K` are known rows; the scores `g` are sums of `Z' e` over blocks. White
residuals need no blocks: `sum g g'` is `sum_j sigma_j^2 Z_j' Z_j`, which estimates the error ten times better than a scatter
does. If neighbours are correlated, blocks of 0.1 s replace it; blocks of 2 s are used in addition, for correlation over longer
times.

**Whitening.** Within each unbroken stretch of usable samples of one output, row t is

    (e_t - sum_k phi_k^(m) e_{t-k}) / sigma_m,   m = min(t - start, order),

with `phi^(m)` and `sigma_m` of the best predictor of order m (Levinson-Durbin), so that also the first samples of a stretch are
white and of unit variance: the exact likelihood of a stationary process. Reference: Brockwell & Davis 1991, 8.7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal, sparse
from scipy.linalg import solve_toeplitz

from tau_dyn.estimate.autoregression import Autoregression, Lags
from tau_dyn.estimate.regression import ROUNDING, RegressionRows, RegressionRun

BLOCK_S = 2.0  # [s] of the blocks of the cluster-robust covariance


def assign_blocks(since: np.ndarray, seconds: float = BLOCK_S) -> np.ndarray:
    """Return the number of the block that each sample (n,) falls in, from times since the first block's start [s]."""
    return (since / seconds + ROUNDING).astype(int)


class Covariance(NamedTuple):
    """Covariances of a least-squares estimate.

    `autoregressive` (r, r) by the autoregressive models, `clustered` (r, r) from blocks, and each output's noise
    model.
    """

    autoregressive: np.ndarray
    clustered: np.ndarray
    models: tuple[Autoregression, ...]


def select_larger_stderr(coloured: np.ndarray, scattered: np.ndarray) -> np.ndarray:
    """Return the larger of the standard errors (r,) that two covariances (r, r) give."""
    return np.sqrt(np.maximum(np.diag(coloured), np.diag(scattered)))


Scores = Callable[[], Iterator[Iterator[RegressionRows]]]
"""Function that yields every run at each call: its weighted base columns and residuals, in order, piece by piece."""


def estimate_covariance(scores: Scores, n_samples: int, R: np.ndarray, known: np.ndarray) -> Covariance:
    """Return the covariances of a weighted least-squares estimate.

    Args:
        scores: Yields every run's weighted base columns (n, m, r) as `W` and weighted residuals (n, m) as `y`; called twice.
        n_samples: Number of usable measurements.
        R: Triangular factor (r, r) of all weighted rows, prior rows included.
        known: Rows (k, r) whose outer products add to `W' Omega W`: prior rows, and uncertainty in addition to the noise.
    """
    scale = np.linalg.norm(R, axis=0)
    inverse = linalg.solve_triangular(R / scale, np.eye(len(R))) / scale[:, None]
    sure = (known @ inverse).T @ (known @ inverse)
    models, blocks, count = _first_pass(scores, inverse)
    coloured = n_samples / max(1, n_samples - len(R)) * _coloured(scores, inverse, models) + sure
    scattered = blocks * count / (count - 1) + sure if count > 1 else coloured
    return Covariance(inverse @ coloured @ inverse.T, inverse @ scattered @ inverse.T, tuple(models))


def _first_pass(scores: Scores, inverse: np.ndarray) -> tuple[list[Autoregression], np.ndarray, int]:
    """Return each output's noise model, and the summed outer products and number of 2 s blocks' scores.

    The scores of a block sum all outputs, as their noise may be common.
    """
    lags: list[Lags] = []
    blocks = _Blocks(len(inverse))
    for run in scores():
        start, open_ = None, np.zeros(0, bool)
        for rows in run:
            start = rows.t[0] if start is None else start
            lags += [Lags() for _ in range(rows.y.shape[1] - len(lags))]
            open_ = open_ if open_.size else np.zeros(len(lags), bool)
            for k, lag in enumerate(lags):
                open_[k] = _add_stretches(lag, rows.y[:, k], rows.usable[:, k], bool(open_[k]))
            score = np.einsum("nmr,nm->nr", rows.W, np.where(rows.usable, rows.y, 0.0)) @ inverse
            blocks.add(assign_blocks(rows.t - start), score, np.any(rows.usable, axis=1))
        blocks.close()
    models = [lag.model() if lag.seen else Autoregression(np.zeros(0), 0.0) for lag in lags]
    return models, blocks.total, blocks.count


def _add_stretches(lags: Lags, e: np.ndarray, usable: np.ndarray, open_: bool) -> bool:
    """Add the unbroken stretches of a residual (n,); return whether the last one may continue in the next piece."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if start > 0 or not open_:
            lags.begin()
        lags.add(e[start:stop])
    return bool(usable[-1]) if len(usable) else open_


class _Blocks:
    """Outer products of the scores of 2 s blocks, summed while rows come in pieces."""

    def __init__(self, r: int) -> None:
        self.total, self.count = np.zeros((r, r)), 0
        self._number, self._sum, self._used = -1, np.zeros(r), False

    def add(self, number: np.ndarray, score: np.ndarray, used: np.ndarray) -> None:
        """Add rows' block numbers (n,), scores (n, r) and whether any output uses them (n,)."""
        edges = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
        for start, stop in zip(edges, [*edges[1:], len(number)], strict=True):
            if number[start] != self._number:
                self.close()
                self._number = int(number[start])
            self._sum = self._sum + score[start:stop].sum(axis=0)
            self._used = self._used or bool(used[start:stop].any())

    def close(self) -> None:
        """End the current block."""
        if self._used:
            self.total += np.outer(self._sum, self._sum)
            self.count += 1
        self._number, self._sum, self._used = -1, np.zeros(len(self._sum)), False


def _coloured(scores: Scores, inverse: np.ndarray, models: list[Autoregression]) -> np.ndarray:
    """Return `Z' C Z` summed over outputs: `Z` all rows, unused ones zero to keep the true lags, `C` the noise's covariance.

    `C = s^2 H' H` with `H` the model's response, so the rows run through `1 / (1 - sum phi_k z^-k)` and their squares are summed.
    """
    total = np.zeros((len(inverse), len(inverse)))
    power = [model.response_power() for model in models]
    for run in scores():
        states: list[np.ndarray] = []
        for rows in run:
            states = states or [np.zeros((len(m.phi), len(inverse))) for m in models]
            for k, model in enumerate(models):
                Z = np.where(rows.usable[:, k, None], rows.W[:, k], 0.0) @ inverse
                if len(model.phi):
                    Z, states[k] = signal.lfilter([1.0], model.denominator, Z, axis=0, zi=states[k])
                total += model.variance / power[k] * (Z.T @ Z)
        for k, state in enumerate(states):
            total += models[k].variance / power[k] * (state.T @ models[k].fading_gramian() @ state)
    return total


SHORT_S = 0.1  # [s] of the short blocks
LAGS = 5  # samples; lags whose correlation is tested
MAX_CORRELATION_Z = 4.0
"""Largest size of each of the first correlations, in standard errors, for a white residual."""


def estimate_score_covariance(
    times: Sequence[np.ndarray], Z: Sequence[np.ndarray], residuals: Sequence[np.ndarray], keep: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return two covariances (r, r) of the scores: from the residual's correlation, and from the scatter of long blocks.

    Args:
        times: Time (n,) of each stretch [s].
        Z: White instruments (n, m, r) of each.
        residuals: White residuals (n, m) of each, zero where an equation is left out.
        keep: Which equations count (n, m).
    """
    freedom = 1 - Z[0].shape[2] / max(sum(int(k.sum()) for k in keep), Z[0].shape[2] + 1)
    coloured = np.zeros((Z[0].shape[2],) * 2)
    for k in range(Z[0].shape[1]):
        if _white([e[:, k] for e in residuals], [x[:, k] for x in keep]):
            count = max(sum(int(x[:, k].sum()) for x in keep), 1)
            power = sum(float(np.sum(e[:, k] ** 2)) for e in residuals) / count
            coloured += power * sum(rows[:, k].T @ rows[:, k] for rows in Z)
        else:
            scores = [rows[:, k] * e[:, k, None] for rows, e in zip(Z, residuals, strict=True)]
            coloured += _scatter(times, scores, SHORT_S)
    together = [np.einsum("nmr,nm->nr", rows, e) for rows, e in zip(Z, residuals, strict=True)]
    return coloured / freedom, _scatter(times, together, BLOCK_S)


def _white(residuals: Sequence[np.ndarray], keep: Sequence[np.ndarray]) -> bool:
    """Return whether the first correlations of one output's residual are within chance."""
    power = sum(float(np.sum(e**2)) for e in residuals) / max(sum(int(x.sum()) for x in keep), 1)
    for lag in range(1, LAGS + 1):
        pairs = sum(int(np.sum(x[lag:] & x[:-lag])) for x in keep)
        total = sum(float(np.sum(e[lag:] * e[:-lag])) for e in residuals)
        if pairs < 10 or abs(total) > MAX_CORRELATION_Z * power * np.sqrt(pairs):
            return False
    return True


def _scatter(times: Sequence[np.ndarray], scores: Sequence[np.ndarray], seconds: float) -> np.ndarray:
    """Return the sum of outer products of the scores of blocks (r, r)."""
    sums = []
    for t, g in zip(times, scores, strict=True):
        _, first = np.unique(assign_blocks(t - t[0], seconds), return_index=True)
        sums.append(np.add.reduceat(g, first, axis=0))
    blocks = np.concatenate(sums)
    blocks = blocks[np.any(blocks != 0, axis=1)]
    return blocks.T @ blocks * (len(blocks) / max(len(blocks) - 1, 1))


@dataclass(frozen=True, eq=False)
class Whitener:
    """Whitening of arrays over runs into white rows.

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

    @property
    def runs(self) -> list[int]:
        """The runs that have rows."""
        return sorted({k // self.n_outputs for k, L in enumerate(self.rows) if L.nnz})

    def __call__(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return white rows (R, ...) of arrays over the runs (n, m, ...); runs without any row are skipped."""
        m = self.n_outputs
        parts = [L @ arrays[k // m][:, k % m] for k, L in enumerate(self.rows) if L.nnz]
        return np.concatenate(parts) if parts else np.zeros((0, *np.shape(arrays[0])[2:]))

    def one(self, output: int, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return the white rows of one output, from arrays over the runs (n, ...)."""
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
