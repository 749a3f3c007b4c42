"""Rows on a common scale: what was measured beforehand, columns of unit norm, and weights that take outliers out of a fit.

    prior     theta_k / s_k = value / s_k          a row of unit noise for each parameter with a `prior_stderr`
    columns   W theta = (W / norm) (norm theta)    a tolerance means the same for a mass in kg and an inertia in kg m^2
    outliers  w(x) = (1 - (x / c)^2)^2 for |x| < c, else 0,   c = 4.685    (Tukey's bisquare)

The bisquare, on residuals scaled by their median absolute deviation, costs 5 % of the information where the noise is Gaussian.
With weights repeated until they settle, the estimate's covariance is that of least squares with these weights times
`(mean w / mean psi')^2`, `psi = x w(x)`: a shifted parameter moves the weights too. Reference: Huber & Ronchetti 2009, 7.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.parameters import Parameters


def build_prior_rows(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (k, p) and values (k,) of the k parameters with a `prior_stderr` among p."""
    known = [(k, p.value, float(p.prior_stderr)) for k, p in enumerate(parameters) if p.prior_stderr]
    rows = np.zeros((len(known), len(parameters)))
    for row, (column, _, stderr) in zip(rows, known, strict=True):
        row[column] = 1 / stderr
    return rows, np.array([value / stderr for _, value, stderr in known])


def scale_columns(W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (N, p) scaled to unit norm, and what they were divided by (p,); 1 for a column of zeros."""
    norm = np.linalg.norm(W, axis=0)
    norm[norm == 0] = 1.0
    return W / norm, norm


def solve_scaled(W: np.ndarray, y: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the parameters (p,) of columns (N, p) that leave least of `y` (N,).

    Args:
        W: Columns.
        y: What they are to explain.
        tolerance: Singular value of the unit columns, relative to the largest, below which a direction is left at zero.
    """
    unit, norm = scale_columns(W)
    return np.linalg.lstsq(unit, y, rcond=tolerance)[0] / norm


BISQUARE = 4.685  # efficiency 95 % where the noise is Gaussian (Beaton & Tukey 1974)
NORMAL_MAD = 0.6745
"""Median absolute deviation of a normal variable of unit variance."""


def estimate_robust_scale(x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return each column's deviation (m,) of `x` (n, m) where `mask` holds; a few wild samples do not move it."""
    found = [np.median(np.abs(x[mask[:, k], k])) if mask[:, k].any() else 0.0 for k in range(x.shape[1])]
    return np.where(np.array(found) > 0, np.array(found) / NORMAL_MAD, 1.0)


def compute_bisquare_weights(x: np.ndarray) -> np.ndarray:
    """Return weights of residuals in units of their deviation."""
    return np.where(np.abs(x) < BISQUARE, (1 - (x / BISQUARE) ** 2) ** 2, 0.0)


def compute_robust_covariance_factor(x: np.ndarray) -> float:
    """Return `mean w / mean psi'`: the covariance factor of a fit with bisquare weights over fixed ones (Huber 1981).

    Args:
        x: Residuals in units of their deviation.
    """
    inside = np.abs(x) < BISQUARE
    share = (x / BISQUARE) ** 2
    slope = np.where(inside, (1 - share) * (1 - 5 * share), 0.0)
    return float(np.mean(compute_bisquare_weights(x)) / max(np.mean(slope), 1e-3))
