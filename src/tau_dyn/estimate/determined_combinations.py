"""Combinations of base parameters that the data tell better than the robot file does, where single ones are hardly told.

Base parameters that a motion hardly tells apart have large errors, and sums of them have small ones. With the covariance C of
the base parameters and their standard deviation D before the data, the directions v of

    D^-1 C D^-1 v = mu v,    mu < 1,

are known better than before. Their span holds every combination that is worth a value. It is written with as few terms as it
has directions: QR with column pivoting chooses the parameter that stands for each, as for base parameters. Reference: Gautier
1991; the prior in the place of a numerical tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy import linalg

from tau_dyn.estimate.base_parameters import BaseParameters
from tau_dyn.estimate.estimate import Estimate

_WIDE = 100.0
"""Standard errors that a parameter without a prior is free to differ by: the data alone tell it."""
_NEGLIGIBLE = 0.1
"""Standard errors by which a term may move its sum and is left out: what the parameter may be off, times its factor."""


@dataclass(frozen=True, eq=False)
class DeterminedCombinations:
    """Combinations with their values.

    Attributes:
        base: The parameter that stands for each combination, and the factors of the others.
        contained: Of each combination, the fixed drive inertias that it contains, with their factors.
        values: Their values (k,), each in the unit of its first parameter.
        stderr: Their standard errors (k,).
    """

    base: BaseParameters
    contained: tuple[dict[str, float], ...]
    values: np.ndarray
    stderr: np.ndarray


def find_determined_combinations(estimate: Estimate, sizes: Mapping[str, float]) -> DeterminedCombinations | None:
    """Return the combinations that the data tell better than the robot file; None where they tell every base parameter.

    Args:
        estimate: The fit.
        sizes: Standard deviation of a parameter before the data, by name, in its unit; the data alone tell the others.
    """
    base, stderr = estimate.base, estimate.stderr
    prior = _compute_prior_stderr(base, stderr, sizes)
    if not np.all(np.isfinite(stderr)) or not len(stderr):
        return None
    variances, directions = np.linalg.eigh(estimate.cov / np.outer(prior, prior))
    known = directions[:, variances < 1.0].T  # in units of the prior
    if not len(known) or len(known) == base.rank:
        return None
    _, order = cast("tuple[np.ndarray, np.ndarray]", linalg.qr(known, mode="r", pivoting=True))
    first = np.sort(order[: len(known)])
    others = np.setdiff1d(np.arange(base.rank), first)
    factors = np.linalg.solve(known[:, first], known[:, others]) * prior[first][:, None] / prior[others]
    weights = np.zeros((len(first), base.rank))
    weights[range(len(first)), first] = 1.0
    weights[:, others] = factors
    errors = np.array([estimate.stderr_of(w) for w in weights])
    composed = _compose(base, weights, first, others)
    moved = np.abs(composed.K) * np.array([sizes.get(base.names[c], np.nan) for c in composed.dropped])
    told = replace(
        composed, K=np.where(moved < _NEGLIGIBLE * errors[:, None], 0.0, composed.K)
    )  # without a prior it stays
    fixed = np.array([estimate.sum_contained(k) for k in range(base.rank)])
    contained = tuple(_sum_contained(estimate, row) for row in weights)
    return DeterminedCombinations(told, contained, weights @ (estimate.beta + fixed), errors)


def _sum_contained(estimate: Estimate, weights: np.ndarray) -> dict[str, float]:
    """Return the fixed drive inertias that a sum of base parameters, weights (r,), contains, with their factors."""
    found: dict[str, float] = {}
    for weight, inside in zip(weights.tolist(), estimate.contained, strict=True):
        for name, factor in inside.items():
            found[name] = found.get(name, 0.0) + weight * factor
    return {name: factor for name, factor in found.items() if factor}


def _compute_prior_stderr(base: BaseParameters, stderr: np.ndarray, sizes: Mapping[str, float]) -> np.ndarray:
    """Return how far each base parameter (r,) may be off before the data, the terms of its sum taken as independent."""
    own = np.array([sizes.get(name, np.nan) for name in base.names])
    terms = np.concatenate([own[base.kept][:, None] ** 2, (base.K * np.nan_to_num(own[base.dropped])) ** 2], axis=1)
    prior = np.sqrt(terms.sum(axis=1))
    return np.where(np.isfinite(prior) & (prior > 0), prior, _WIDE * stderr)


def _compose(base: BaseParameters, weights: np.ndarray, first: np.ndarray, others: np.ndarray) -> BaseParameters:
    """Return combinations (k, r) of base parameters as combinations of all parameters."""
    dropped = np.concatenate([base.dropped, base.kept[others]])
    return BaseParameters(
        base.names, base.kept[first], dropped, np.concatenate([weights @ base.K, weights[:, others]], axis=1)
    )
