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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, signal

from tau_dyn.estimate.regression import Regression

BLOCK_S = 2.0
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


def fit_autoregression(stretches: list[np.ndarray], max_order: int = MAX_ORDER) -> Autoregression:
    """Fit an autoregressive model to unbroken stretches (n_i,) of a residual by least squares, its order by AIC."""
    everything = np.concatenate(stretches)
    variance = float(np.mean(everything**2))
    best, best_aic = np.zeros(0), len(everything) * np.log(max(variance, 1e-300))
    for order in range(1, max_order + 1):
        rows = [_lagged(x, order) for x in stretches if len(x) > order]
        n = sum(len(x) for x in rows)
        if n < 10 * max_order:
            break
        past = np.concatenate([x[:, 1:] for x in rows])
        now = np.concatenate([x[:, 0] for x in rows])
        phi = np.linalg.lstsq(past, now, rcond=None)[0]
        innovation = float(np.mean((now - past @ phi) ** 2))
        aic = len(everything) * np.log(max(innovation, 1e-300)) + 2 * order
        if aic < best_aic:
            best, best_aic = phi, aic
    return Autoregression(_stable(best), variance)


def robust_covariance(
    regression: Regression, W: list[np.ndarray], residuals: list[np.ndarray], R: np.ndarray, known: np.ndarray
) -> Covariance:
    """Return how certain a weighted least-squares estimate is.

    Args:
        regression: Gives runs, masks and clocks.
        W: Weighted base columns of each run (n, m, r).
        residuals: Weighted residuals of each run (n, m).
        R: Triangular factor (r, r) of all weighted rows, prior rows included.
        known: Rows (k, r) whose outer products add to `W' Omega W`: prior rows, and what is uncertain beside the noise.
    """
    scale = np.linalg.norm(R, axis=0)
    inverse = linalg.solve_triangular(R / scale, np.eye(len(R))) / scale[:, None]
    U = [rows @ inverse for rows in W]
    sure = (known @ inverse).T @ (known @ inverse)
    coloured, models = _autoregressive_middle(regression, U, residuals)
    blocks, count = _block_middle(regression, U, residuals)
    coloured = coloured + sure
    scattered = blocks * count / (count - 1) + sure if count > 1 else coloured
    return Covariance(inverse @ coloured @ inverse.T, inverse @ scattered @ inverse.T, tuple(models))


def _autoregressive_middle(
    regression: Regression, W: list[np.ndarray], residuals: list[np.ndarray]
) -> tuple[np.ndarray, list[Autoregression]]:
    r = W[0].shape[2]
    total, models = np.zeros((r, r)), []
    dof = max(1, regression.n_samples - r)
    for k in range(len(regression.outputs)):
        stretches = [e[s, k] for run, e in zip(regression.runs, residuals, strict=True) for s in run.segments(k)]
        model = fit_autoregression(stretches) if stretches else Autoregression(np.zeros(0), 0.0)
        models.append(model)
        scale = regression.n_samples / dof
        for run, rows in zip(regression.runs, W, strict=True):
            Z = np.where(run.usable[:, k, None], rows[:, k], 0.0)  # zero rows keep the true lags across gaps
            total += scale * Z.T @ linalg.matmul_toeplitz(model.autocovariance(len(Z)), Z)
    return total, models


def _block_middle(regression: Regression, W: list[np.ndarray], residuals: list[np.ndarray]) -> tuple[np.ndarray, int]:
    """Sum the outer products of the scores of 2 s blocks; all outputs together, as their noise may be common."""
    r = W[0].shape[2]
    total, count = np.zeros((r, r)), 0
    for run, rows, e in zip(regression.runs, W, residuals, strict=True):
        score = np.einsum("nmr,nm->nr", rows, np.where(run.usable, e, 0.0))
        block = ((run.t - run.t[0]) / BLOCK_S).astype(int)
        used = run.usable.any(axis=1)
        for b in np.unique(block[used]):
            g = score[block == b].sum(axis=0)
            total += np.outer(g, g)
            count += 1
    return total, count


def _lagged(x: np.ndarray, order: int) -> np.ndarray:
    return np.column_stack([x[order - k : len(x) - k] for k in range(order + 1)])


def _stable(phi: np.ndarray) -> np.ndarray:
    """Pull poles outside 0.999 back onto that circle."""
    if phi.size == 0:
        return phi
    poles = np.roots(np.concatenate([[1.0], -phi]))
    size = np.abs(poles)
    if np.all(size < 0.999):
        return phi
    return -np.real(np.poly(np.where(size < 0.999, poles, poles / np.maximum(size, 1e-12) * 0.999)))[1:]
