r"""What makes a motion good, as a function of its information matrix M, with the derivative that a search needs.

    d          -log det M / r              the mean log variance: the volume of the confidence ellipsoid; scale-free
    condition  log cond of M with unit diagonal, halved: of the regressor with unit columns
    worst      log of the largest relative standard error, smoothly: (1 / p) log sum_k (s_k / scale_k)^p

Each returns its value and `Gamma = d value / d M`, symmetric, so that `d value = sum Gamma * dM`. The determinant has a
gradient everywhere and does not depend on units; a condition number has none where two singular values meet, and bounds no
standard error. Reference: Kiefer & Wolfowitz 1960; Gautier & Khalil 1992; Swevers et al. 1997.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_POWER = 12.0  # of the p-norm that stands for the largest singular value, smooth where two are equal

Criterion = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]
"""From M (r, r) and the parameters' scales (r,) to a value and its derivative (r, r)."""


def compute_d_criterion(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return minus the mean log eigenvalue of M."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    inverse = (vectors / values) @ vectors.T
    value = -(np.sum(np.log(values)) - 2 * np.sum(np.log(d))) / len(M)
    return float(value), -inverse * np.outer(d, d) / len(M)


def compute_condition_criterion(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return half the log condition number of M at unit diagonal."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    gamma = np.zeros_like(M)
    for k, sign in ((-1, 0.5), (0, -0.5)):
        u = vectors[:, k]
        gamma += sign * (np.outer(u * d, u * d) / values[k] - np.diag(u**2 * d**2))
    return float(0.5 * np.log(values[-1] / values[0])), gamma


def compute_largest_error(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log of the largest standard error relative to the scales, smoothed by a power mean."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    C = (vectors / values) @ vectors.T * np.outer(d, d)
    s = np.sqrt(np.diag(C)) / scale
    share = (s / s.max()) ** _POWER
    weight = share / share.sum() / (2 * np.diag(C))
    return float(np.log(s.max()) + np.log(share.sum()) / _POWER), -(C * weight) @ C


CRITERIA: dict[str, Criterion] = {
    "d": compute_d_criterion,
    "condition": compute_condition_criterion,
    "worst": compute_largest_error,
}
"""Every criterion by the name that the command line takes."""


def _unit(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    return d, M * np.outer(d, d)


def _eigen(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = np.linalg.eigh(S)
    return np.maximum(values, 1e-14 * max(values[-1], 1e-300)), vectors
