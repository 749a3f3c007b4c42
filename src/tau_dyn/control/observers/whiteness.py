r"""Are a filter's innovations white, as they are when model and covariances are right?

Portmanteau test of Ljung and Box (1978), each channel by itself: `N (N + 2) sum r_k^2 / (N - k)` over the first lags follows a
chi-squared law if the innovations are white. Beside it the size of the innovations over what the filter expects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class Whiteness:
    """What innovations say of a filter.

    Attributes:
        p_value: Of the hypothesis that they are white, one a channel (p,).
        correlation: The largest autocorrelation among the lags, one a channel (p,).
        ratio: Their standard deviation over the expected one (p,).
    """

    p_value: np.ndarray
    correlation: np.ndarray
    ratio: np.ndarray


def check_whiteness(innovations: np.ndarray, covariance: np.ndarray, lags: int = 20) -> Whiteness:
    """Return how white innovations (N, p) are, of which the filter expects a covariance (p, p)."""
    n = len(innovations)
    if n <= 2 * lags:
        raise InputError("too_little_data", f"{n} samples are too few to look at correlations over {lags} lags")
    x = innovations - innovations.mean(axis=0)
    power = np.mean(x**2, axis=0)
    r = np.array([np.sum(x[k:] * x[:-k], axis=0) / (n * power) for k in range(1, lags + 1)])
    statistic = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1))[:, None], axis=0)
    worst = np.abs(r).max(axis=0)
    return Whiteness(
        np.asarray(chi2.sf(statistic, lags)), worst, np.sqrt(np.mean(innovations**2, axis=0) / np.diag(covariance))
    )
