"""What a sample's scatter may be: bounds that come from the number of draws, not from a percentage."""

from __future__ import annotations

import numpy as np
from scipy import stats

CHANCE = 1e-3  # that a right statement fails, over all entries together


def assert_scatter(draws: np.ndarray, stated: np.ndarray | float) -> None:
    """Assert that draws (n, ...) of a normal quantity scatter with the standard deviation stated (...), by chi-square."""
    n = len(draws)
    ratio = np.var(draws, axis=0, ddof=1) / np.square(stated)
    assert_variance_ratio(ratio, n - 1)


def assert_variance_ratio(ratio: np.ndarray | float, dof: int) -> None:
    """Assert that estimated over true variances (...), each of so many degrees of freedom, lie within chi-square's bounds."""
    low, high = stats.chi2.ppf([CHANCE / 2 / np.size(ratio), 1 - CHANCE / 2 / np.size(ratio)], dof) / dof
    assert np.all((low < np.asarray(ratio)) & (np.asarray(ratio) < high)), (low, ratio, high)
