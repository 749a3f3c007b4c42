r"""Weights that take outliers out of a fit: Tukey's bisquare on residuals scaled by their median absolute deviation.

    w(x) = (1 - (x / c)^2)^2 for |x| < c, else 0,   c = 4.685,

which costs 5 % of the information where the noise is Gaussian. With weights repeated until they settle, the estimate's
covariance is that of least squares with these weights times `(mean w / mean psi')^2`, `psi = x w(x)`: a shifted parameter moves
the weights too. Reference: Huber & Ronchetti 2009, Robust Statistics, 7.
"""

from __future__ import annotations

import numpy as np

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
