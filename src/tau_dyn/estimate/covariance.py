r"""How certain least squares is when its residual is coloured.

With `W = U R` the weighted rows, `U` orthonormal, `cov = R^-1 (U' Omega U) R^-T`. `U' Omega U` is found twice: with `Omega`
the autocovariance of an autoregressive model of each output's residual at true time lags, gaps in the mask included; and
from the scatter of 2 s blocks' scores, which also sees colour that no such model has. Of any number wanted the larger standard
error counts; the matrices themselves stay apart, as inflating one parameter by parameter would destroy what correlations say
about sums (and, in `physical_consistency.py`, move an estimate in directions that the data forbid).
The point estimate stays that of weighted least squares: whitening it would amplify what the model misses at high
frequency (on EMPS it moves the viscous coefficient by 4 %). Reference: White 1980; Newey & West 1987; Ljung 1999, 9.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal

from tau_dyn.estimate.autoregression import Autoregression, Lags
from tau_dyn.estimate.regression import RegressionRows

BLOCK_S = 2.0  # [s] of the blocks of the cluster-robust covariance
ROUNDING = 1e-6  # of a block: a clock's last digit must not move a sample from one to the next


def assign_blocks(since: np.ndarray, seconds: float = BLOCK_S) -> np.ndarray:
    """Return the number of the block that each sample (n,) falls in, from times since the first block's start [s]."""
    return (since / seconds + ROUNDING).astype(int)


class Covariance(NamedTuple):
    """What least squares knows about its errors.

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
"""Yields every run anew: its weighted base columns and residuals, in order, piece by piece."""


def estimate_covariance(scores: Scores, n_samples: int, R: np.ndarray, known: np.ndarray) -> Covariance:
    """Return how certain a weighted least-squares estimate is.

    Args:
        scores: Yields every run's weighted base columns (n, m, r) as `W` and weighted residuals (n, m) as `y`; called twice.
        n_samples: Number of usable measurements.
        R: Triangular factor (r, r) of all weighted rows, prior rows included.
        known: Rows (k, r) whose outer products add to `W' Omega W`: prior rows, and what is uncertain beside the noise.
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

    All outputs of a block together, as their noise may be common.
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
    """Take in the unbroken stretches of a residual (n,); return whether the last one may go on in the next piece."""
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
        """Take in rows' block numbers (n,), scores (n, r) and whether any output uses them (n,)."""
        edges = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
        for start, stop in zip(edges, [*edges[1:], len(number)], strict=True):
            if number[start] != self._number:
                self.close()
                self._number = int(number[start])
            self._sum = self._sum + score[start:stop].sum(axis=0)
            self._used = self._used or bool(used[start:stop].any())

    def close(self) -> None:
        """End the block that is open."""
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
            total += models[k].variance / power[k] * _fading(models[k], state)
    return total


def _fading(model: Autoregression, state: np.ndarray) -> np.ndarray:
    """Return the summed squares (r, r) of what the filter still gives after a run's end."""
    total = np.zeros((state.shape[1], state.shape[1]))
    if not len(model.phi):
        return total
    for _ in range(16):  # 65 536 samples: the slowest pole, 0.999, has faded to 1e-28
        Z, state = signal.lfilter([1.0], model.denominator, np.zeros((4096, state.shape[1])), axis=0, zi=state)
        grown = total + Z.T @ Z
        if np.array_equal(grown, total):
            break
        total = grown
    return total
