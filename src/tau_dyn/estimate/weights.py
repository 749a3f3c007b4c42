"""Weights of rows: prior knowledge, columns of unit size, and robust losses against bad measurements.

    prior     theta_k / s_k = value / s_k          a row of unit noise for each parameter with a `prior_stderr`
    columns   W theta = (W / norm) (norm theta)    a tolerance means the same for a mass in kg and an inertia in kg m^2
    losses    d_k^2 = sum of a measurement's squared residuals, each by its noise;   m of them.
              Huber: w = min(1, c / d);   biweight: w = (1 - (d / c)^2)^2 for d < c, else 0;   rho' = 2 d w, psi = d w.

A measurement is good or bad as a whole, so its weight depends on its Mahalanobis distance d. `c` is set so that the fit keeps
`efficiency` of the information if the noise is Gaussian:

    eff = E[psi'(d) / m + (1 - 1 / m) psi(d) / d]^2 / (E[psi(d)^2] / m),   d^2 ~ chi^2_m;

for m = 1 and 95 % the biweight has c = 4.685. A shifted parameter changes the weights, too, which makes the covariance larger
than that of fixed weights. Reference: Huber & Ronchetti 2009, 7 and 8; Maronna et al. 2019, 6.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, cast

import numpy as np
from scipy import integrate, linalg, optimize, stats

from tau_dyn.exceptions import UnknownName
from tau_dyn.parameters import Parameters


def build_prior_rows(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (k, p) and values (k,) of the k parameters with a `prior_stderr` among p."""
    known = [(k, p.value, float(p.prior_stderr)) for k, p in enumerate(parameters) if p.prior_stderr]
    rows = np.zeros((len(known), len(parameters)))
    for row, (column, _, stderr) in zip(rows, known, strict=True):
        row[column] = 1 / stderr
    return rows, np.array([value / stderr for _, value, stderr in known])


def scale_columns(W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (N, p) scaled to unit norm, and their divisors (p,); 1 for a column of zeros."""
    norm = np.linalg.norm(W, axis=0)
    norm[norm == 0] = 1.0
    return W / norm, norm


def solve_scaled(W: np.ndarray, y: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the least-squares parameters (p,) of columns (N, p) for `y` (N,).

    Args:
        W: Columns.
        y: Values to be explained.
        tolerance: Singular value of the unit columns, relative to the largest, below which a direction is left at zero.
    """
    unit, norm = scale_columns(W)
    try:
        return np.linalg.lstsq(unit, y, rcond=tolerance)[0] / norm
    except np.linalg.LinAlgError:  # LAPACK's divide and conquer may fail where its QR iterations converge
        return cast(Any, linalg.lstsq(unit, y, cond=tolerance, lapack_driver="gelss"))[0] / norm


BISQUARE = 4.685  # efficiency 95 % if the noise is Gaussian (Beaton & Tukey 1974)
NORMAL_MAD = 0.6745
"""Median absolute deviation of a normal variable of unit variance."""


def estimate_robust_scale(x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return each column's deviation (m,) of `x` (n, m) where `mask` holds; robust to a few outliers."""
    found = [np.median(np.abs(x[mask[:, k], k])) if mask[:, k].any() else 0.0 for k in range(x.shape[1])]
    return np.where(np.array(found) > 0, np.array(found) / NORMAL_MAD, 1.0)


def compute_bisquare_weights(x: np.ndarray) -> np.ndarray:
    """Return weights of residuals in units of their deviation."""
    return _weight("biweight", np.abs(x), BISQUARE)


def compute_robust_covariance_factor(x: np.ndarray) -> float:
    """Return `mean w / mean psi'`: the covariance factor of a fit with bisquare weights over fixed ones (Huber 1981).

    Args:
        x: Residuals in units of their deviation.
    """
    slope = np.mean(_slope("biweight", np.abs(x), BISQUARE))
    return float(np.mean(compute_bisquare_weights(x)) / max(slope, 1e-3))


LOSSES = ("none", "huber", "biweight")
EFFICIENCY = 0.95  # of robust weights if the noise is Gaussian, the usual choice (Huber 1981)


def compute_robust_weights(loss: str, distance: np.ndarray, m: int) -> np.ndarray:
    """Return weights (N,) of measurements at distances (N,) in units of the noise, for `m` residuals per measurement."""
    if loss == "none":
        return np.ones(len(distance))
    return _weight(loss, distance, compute_tuning_constant(loss, m))


def estimate_distance_scale(distance: np.ndarray, m: int | np.ndarray) -> float:
    """Return the ratio of the measurements' scatter to the noise, from the median, which is robust to outliers.

    Args:
        distance: Distances of measurements (N,), in units of the noise.
        m: Independent residuals of a measurement, or of each (N,).
    """
    return float(np.median(distance / np.sqrt(stats.chi2.ppf(0.5, m))))


@lru_cache(maxsize=32)
def compute_tuning_constant(loss: str, m: int, efficiency: float = EFFICIENCY) -> float:
    """Return the constant `c` of a loss for `m` residuals per measurement."""
    if loss not in LOSSES[1:]:
        raise UnknownName("kind of robust weights", loss, LOSSES)
    high = 40.0 + 4 * m
    return float(optimize.brentq(lambda c: _efficiency(loss, c, m) - efficiency, 0.3, high, xtol=1e-6))  # type: ignore[arg-type]


def _weight(loss: str, d: np.ndarray, c: float) -> np.ndarray:
    if loss == "huber":
        return np.minimum(1.0, c / np.maximum(d, 1e-300))
    return np.where(d < c, (1 - (d / c) ** 2) ** 2, 0.0)


def _slope(loss: str, d: np.ndarray, c: float) -> np.ndarray:
    """Return `psi'`, with `psi = d w(d)`."""
    if loss == "huber":
        return (d < c).astype(float)
    return np.where(d < c, (1 - (d / c) ** 2) * (1 - 5 * (d / c) ** 2), 0.0)


def _efficiency(loss: str, c: float, m: int) -> float:
    end = float(np.sqrt(stats.chi2.ppf(1 - 1e-13, m)))
    d = np.linspace(1e-9, end, 40001)  # the slope of Huber has a step
    density = stats.chi.pdf(d, m)
    w, slope = _weight(loss, d, c), _slope(loss, d, c)
    turned = integrate.simpson((slope / m + (1 - 1 / m) * w) * density, x=d)
    spread = integrate.simpson((d * w) ** 2 * density, x=d) / m
    return float(turned**2 / spread)
