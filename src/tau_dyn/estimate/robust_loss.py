r"""Losses that take bad measurements out of a fit; one is good or bad as a whole, so they hang on its Mahalanobis distance.

    d_k^2 = sum of a measurement's squared residuals, each by its noise;   m of them.
    Huber: w = min(1, c / d);   biweight: w = (1 - (d / c)^2)^2 for d < c, else 0;   rho' = 2 d w, psi = d w.

`c` is set so that the fit keeps `efficiency` of the information where the noise is Gaussian:

    eff = E[psi'(d) / m + (1 - 1 / m) psi(d) / d]^2 / (E[psi(d)^2] / m),   d^2 ~ chi^2_m.

Reference: Huber & Ronchetti 2009, ch. 8; Maronna et al. 2019, 6.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import integrate, optimize, stats

from tau_dyn.exceptions import UnknownName

LOSSES = ("none", "huber", "biweight")
EFFICIENCY = 0.95  # of robust weights where the noise is Gaussian, the usual choice (Huber 1981)


def compute_robust_weights(loss: str, distance: np.ndarray, m: int) -> np.ndarray:
    """Return weights (N,) of measurements at distances (N,) in units of the noise; `m` residuals a measurement."""
    if loss == "none":
        return np.ones(len(distance))
    return _weight(loss, distance, compute_tuning_constant(loss, m))


def compute_loss(loss: str, distance: np.ndarray, m: int) -> np.ndarray:
    """Return `rho` (N,) of measurements at distances (N,): the squared distance where nothing is amiss."""
    if loss == "none":
        return distance**2
    c = compute_tuning_constant(loss, m)
    if loss == "huber":
        return np.where(distance < c, distance**2, 2 * c * distance - c**2)
    return c**2 / 3 * (1 - (1 - np.minimum(distance / c, 1.0) ** 2) ** 3)


def compute_loss_covariance_factor(loss: str, distance: np.ndarray, m: int) -> float:
    """Return the covariance of a fit over that of the weights taken as fixed: a shifted parameter moves the weights too."""
    if loss == "none":
        return 1.0
    c = compute_tuning_constant(loss, m)
    w = _weight(loss, distance, c)
    turned = float(np.mean(_slope(loss, distance, c) / m + (1 - 1 / m) * w))
    return float(np.mean((distance * w) ** 2) / m * np.mean(w) / max(turned, 1e-3) ** 2)


def estimate_distance_scale(distance: np.ndarray, m: int) -> float:
    """Return by how much measurements scatter more than the noise says, from the median; wild ones do not move it."""
    return float(np.median(distance) / np.sqrt(stats.chi2.ppf(0.5, m)))


@lru_cache(maxsize=32)
def compute_tuning_constant(loss: str, m: int, efficiency: float = EFFICIENCY) -> float:
    """Return the constant `c` of a loss for `m` residuals a measurement."""
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
