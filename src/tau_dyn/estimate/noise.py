r"""How certain least squares is when its residual is coloured.

With `W = U R` the weighted rows, `U` orthonormal, `cov = R^-1 (U' Omega U) R^-T`. `U' Omega U` is found twice: with `Omega`
the autocovariance of an autoregressive model of each output's residual at true time lags, gaps in the mask included; and
from the scatter of 2 s blocks' scores, which also sees colour that no such model has. Of any number wanted the larger standard
error counts; the matrices themselves stay apart, as inflating one parameter by parameter would destroy what correlations say
about sums (and, in `consistent.py`, move an estimate in directions that the data forbid).
The point estimate stays that of weighted least squares: whitening it would amplify what the model misses at high
frequency (on EMPS it moves the viscous coefficient by 4 %). Reference: White 1980; Newey & West 1987; Ljung 1999, 9.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal

from tau_dyn.estimate.regression import Regression, Rows

BLOCK_S = 2.0
ROUNDING = 1e-6  # of a block: a clock's last digit must not move a sample from one to the next
MAX_ORDER = 12


@dataclass(frozen=True, eq=False)
class Autoregression:
    """`e_t = sum_k phi_k e_{t-k} + u_t`; `phi` (order,), `variance` that of the process itself."""

    phi: np.ndarray
    variance: float

    def autocovariance(self, n: int) -> np.ndarray:
        """Return the autocovariance at lags 0 .. n - 1 (n,)."""
        p = len(self.phi)
        if p == 0:
            return np.concatenate([[self.variance], np.zeros(n - 1)])
        # impulse response of the process, long enough for its slowest pole (roots lie within 0.999)
        impulse = np.zeros(max(n, 4096))
        impulse[0] = 1.0
        h = np.asarray(signal.lfilter([1.0], np.concatenate([[1.0], -self.phi]), impulse))
        covariance = signal.fftconvolve(h, h[::-1])[len(h) - 1 :][:n]
        return covariance * (self.variance / covariance[0])


class Covariance(NamedTuple):
    """What least squares knows about its errors.

    `coloured` (r, r) by the autoregressive models, `scattered` (r, r) from blocks, and each output's noise
    model.
    """

    coloured: np.ndarray
    scattered: np.ndarray
    models: tuple[Autoregression, ...]


Scores = Callable[[], Iterator[Iterator[Rows]]]
"""Yields every run anew: its weighted base columns and residuals, in order, piece by piece."""


def fit_autoregression(stretches: list[np.ndarray], max_order: int = MAX_ORDER) -> Autoregression:
    """Fit an autoregressive model to unbroken stretches (n_i,) of a residual by least squares, its order by AIC."""
    lags = Lags(max_order)
    for stretch in stretches:
        lags.begin()
        lags.add(stretch)
    return lags.model()


class Lags:
    """The past of a residual beside its present, summed up for every order, while stretches come in pieces."""

    def __init__(self, max_order: int = MAX_ORDER) -> None:
        """Start with no samples."""
        self.max_order = max_order
        self._whole = _Triangle(max_order + 1)  # samples with all of their past
        self._early = [_Triangle(k + 1) for k in range(max_order)]  # the k-th sample of a stretch
        self._squares, self._count = 0.0, 0
        self._before = np.zeros(0)

    @property
    def seen(self) -> bool:
        """Whether there were any samples."""
        return self._count > 0

    def begin(self) -> None:
        """Say that what comes next does not follow what came before."""
        self._before = np.zeros(0)

    def add(self, piece: np.ndarray) -> None:
        """Take in the next samples (n,) of the stretch."""
        self._squares += float(np.sum(piece**2))
        self._count += len(piece)
        x, width = np.concatenate([self._before, piece]), self.max_order + 1
        for k in range(len(self._before), min(self.max_order, len(x))):
            self._early[k].add(x[k::-1][None] if k else x[:1][None])
        if len(x) >= width:
            first = max(0, len(self._before) - self.max_order)
            self._whole.add(np.lib.stride_tricks.sliding_window_view(x, width)[first:, ::-1])
        self._before = x[-self.max_order :]

    def model(self) -> Autoregression:
        """Return the model of everything taken in."""
        variance = self._squares / self._count
        best, best_aic = np.zeros(0), self._count * np.log(max(variance, 1e-300))
        for order in range(1, self.max_order + 1):
            parts = [self._whole, *self._early[order:]]
            n = sum(part.count for part in parts)
            if n < 10 * self.max_order:
                break
            rows = np.concatenate([part.R[:, : order + 1] for part in parts])
            phi = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
            innovation = float(np.sum((rows[:, 0] - rows[:, 1:] @ phi) ** 2)) / n
            aic = self._count * np.log(max(innovation, 1e-300)) + 2 * order
            if aic < best_aic:
                best, best_aic = phi, aic
        return Autoregression(_stable(best), variance)


class _Triangle:
    """Rows of k numbers, kept as their triangular factor once there are many."""

    def __init__(self, k: int) -> None:
        self.count, self._size, self._rows = 0, 0, [np.zeros((0, k))]

    def add(self, rows: np.ndarray) -> None:
        """Take in rows (n, k)."""
        self.count += len(rows)
        self._size += len(rows)
        self._rows.append(rows)
        if self._size > 8192:
            self._rows, self._size = [self.R], 0

    @property
    def R(self) -> np.ndarray:
        """The rows' triangular factor."""
        return np.asarray(np.linalg.qr(np.concatenate(self._rows), mode="r"))


def robust_covariance(
    regression: Regression, W: list[np.ndarray], residuals: list[np.ndarray], R: np.ndarray, known: np.ndarray
) -> Covariance:
    """Return how certain a weighted least-squares estimate is, from a regression in memory.

    Args:
        regression: Gives runs, masks and clocks.
        W: Weighted base columns of each run (n, m, r).
        residuals: Weighted residuals of each run (n, m).
        R: Triangular factor (r, r) of all weighted rows, prior rows included.
        known: Rows (k, r) whose outer products add to `W' Omega W`: prior rows, and what is uncertain beside the noise.
    """

    def scores() -> Iterator[Iterator[Rows]]:
        for run, rows, e in zip(regression.runs, W, residuals, strict=True):
            yield iter([Rows(run.t, rows, e, run.usable)])

    return covariance(scores, regression.n_samples, R, known)


def covariance(scores: Scores, n_samples: int, R: np.ndarray, known: np.ndarray) -> Covariance:
    """Return how certain a weighted least-squares estimate is; see `robust_covariance`.

    Args:
        scores: Yields every run's weighted base columns (n, m, r) as `W` and weighted residuals (n, m) as `y`; called twice.
        n_samples: Number of usable measurements.
        R: Triangular factor (r, r) of all weighted rows, prior rows included.
        known: Rows (k, r) whose outer products add to `W' Omega W`.
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
            blocks.add(((rows.t - start) / BLOCK_S + ROUNDING).astype(int), score, np.any(rows.usable, axis=1))
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
    power = [_response_power(model) for model in models]
    for run in scores():
        states: list[np.ndarray] = []
        for rows in run:
            states = states or [np.zeros((len(m.phi), len(inverse))) for m in models]
            for k, model in enumerate(models):
                Z = np.where(rows.usable[:, k, None], rows.W[:, k], 0.0) @ inverse
                if len(model.phi):
                    Z, states[k] = signal.lfilter([1.0], np.concatenate([[1.0], -model.phi]), Z, axis=0, zi=states[k])
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
        Z, state = signal.lfilter(
            [1.0], np.concatenate([[1.0], -model.phi]), np.zeros((4096, state.shape[1])), axis=0, zi=state
        )
        grown = total + Z.T @ Z
        if np.array_equal(grown, total):
            break
        total = grown
    return total


def _response_power(model: Autoregression) -> float:
    """Return the sum of squares of the model's impulse response."""
    if not len(model.phi):
        return 1.0
    impulse = np.zeros(65536)
    impulse[0] = 1.0
    return float(np.sum(np.asarray(signal.lfilter([1.0], np.concatenate([[1.0], -model.phi]), impulse)) ** 2))


def _stable(phi: np.ndarray) -> np.ndarray:
    """Pull poles outside 0.999 back onto that circle."""
    if phi.size == 0:
        return phi
    poles = np.roots(np.concatenate([[1.0], -phi]))
    size = np.abs(poles)
    if np.all(size < 0.999):
        return phi
    return -np.real(np.poly(np.where(size < 0.999, poles, poles / np.maximum(size, 1e-12) * 0.999)))[1:]
