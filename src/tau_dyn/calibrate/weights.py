r"""Weights that take bad poses out of a fit. A pose is good or bad as a whole, so the weight hangs on its Mahalanobis distance.

    d_k^2 = sum of a pose's squared residuals, each by its noise;   m of them.
    Huber: w = min(1, c / d);   biweight: w = (1 - (d / c)^2)^2 for d < c, else 0.

`c` is set so that the fit keeps `efficiency` of the information where the noise is Gaussian:

    eff = E[psi'(d) / m + (1 - 1 / m) psi(d) / d]^2 / (E[psi(d)^2] / m),   d^2 ~ chi^2_m.

Reference: Huber & Ronchetti 2009, ch. 8; Maronna et al. 2019, 6.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import integrate, optimize, stats

from tau_dyn.exceptions import UnknownName

KINDS = ("none", "huber", "biweight")
EFFICIENCY = 0.95  # of robust weights where the noise is Gaussian, the usual choice (Huber 1981)


def compute_robust_weights(kind: str, distance: np.ndarray, m: int) -> np.ndarray:
    """Return weights (N,) of poses at distances (N,) in units of the noise; `m` residuals a pose."""
    if kind == "none":
        return np.ones(len(distance))
    return _weight(kind, distance, compute_tuning_constant(kind, m))


def estimate_robust_scale(distance: np.ndarray, m: int) -> float:
    """Return by how much poses scatter more than the noise says, from the median; wild poses do not move it."""
    return float(np.median(distance) / np.sqrt(stats.chi2.ppf(0.5, m)))


@lru_cache(maxsize=32)
def compute_tuning_constant(kind: str, m: int, efficiency: float = EFFICIENCY) -> float:
    """Return the constant `c` of a kind of weights for `m` residuals a pose."""
    if kind not in KINDS[1:]:
        raise UnknownName("kind of robust weights", kind, KINDS)
    high = 40.0 + 4 * m
    return float(optimize.brentq(lambda c: _efficiency(kind, c, m) - efficiency, 0.3, high, xtol=1e-6))  # type: ignore[arg-type]


def _weight(kind: str, d: np.ndarray, c: float) -> np.ndarray:
    if kind == "huber":
        return np.minimum(1.0, c / np.maximum(d, 1e-300))
    return np.where(d < c, (1 - (d / c) ** 2) ** 2, 0.0)


def _slope(kind: str, d: np.ndarray, c: float) -> np.ndarray:
    """Return `psi'`, with `psi = d w(d)`."""
    if kind == "huber":
        return (d < c).astype(float)
    return np.where(d < c, (1 - (d / c) ** 2) * (1 - 5 * (d / c) ** 2), 0.0)


def _efficiency(kind: str, c: float, m: int) -> float:
    end = float(np.sqrt(stats.chi2.ppf(1 - 1e-13, m)))
    d = np.linspace(1e-9, end, 40001)  # the slope of Huber has a step
    density = stats.chi.pdf(d, m)
    w, slope = _weight(kind, d, c), _slope(kind, d, c)
    turned = integrate.simpson((slope / m + (1 - 1 / m) * w) * density, x=d)
    spread = integrate.simpson((d * w) ** 2 * density, x=d) / m
    return float(turned**2 / spread)
