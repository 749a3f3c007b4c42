"""Which of several readings of the same numbers is right: by likelihood, at one number of parameters.

Readings do not differ in what they fit, so their maximum log-likelihoods are compared as they are: `-n log(error)` of `n` numbers
whose error level is estimated. Misfits of a model that is wrong in other ways are alike between measurements, which makes `n` too
large a count: the error has to fall by a factor as well. Reference: Burnham & Anderson 2002, 2.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MAX_ERROR_LEFT = 0.3
"""Error with the right reading over that as written: effects of a machine's own size seldom take more than two thirds."""
_LEVEL = 1e-3
"""Share of the likelihood of all readings that the one as written may keep; of findings that need no held-out part."""
_ALIKE = 1e-3
"""Relative difference of errors below which two readings are one: equivalent conventions differ by iteration only."""


def prefer_reading(errors: Sequence[float], n_numbers: int) -> bool:
    """Tell whether the best reading replaces the first, the one as written.

    Args:
        errors: Error level of each reading, the one as written first.
        n_numbers: Numbers that each was compared at.
    """
    best = min(errors)
    if not best < MAX_ERROR_LEFT * errors[0]:
        return False
    return n_numbers * np.log(errors[0] / max(best, 1e-300)) > np.log(len(errors) / _LEVEL)


def find_equivalent(errors: Sequence[float]) -> np.ndarray:
    """Return the indices of readings that the data do not tell from the best one."""
    return np.flatnonzero(np.asarray(errors) <= (1 + _ALIKE) * min(errors))
