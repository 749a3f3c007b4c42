"""Result of an estimation: values, uncertainty, parameters that are not identifiable, and values moved by physical constraints.

**Sums.** A sum `w' theta` can be identifiable even if its terms are not: if and only if `w` is in the row space of the columns,
that is if `w_D = K' w_B`; then it equals `w_B' beta`. So a published base parameter, or a total mass, can be compared for any
choice of base on either side.

**Determined combinations** of base parameters are known from the data better than from the robot file, even if single base
parameters are poorly determined. Base parameters that a motion hardly separates have large errors, and sums of them have small
ones. With the covariance C of the base parameters and their standard deviation D before the data, the directions v of

    D^-1 C D^-1 v = mu v,    mu < 1,

are known better than before. Their span contains every combination that is worth a value. It is written with as few terms as it
has directions: QR with column pivoting chooses the leading parameter of each, as for base parameters. Reference: Gautier
1991; the prior replaces a numerical tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
from scipy import linalg

from tau_dyn.estimate.autoregression import Autoregression
from tau_dyn.estimate.base_parameters import BaseParameters, find_contained
from tau_dyn.estimate.covariance import select_larger_stderr
from tau_dyn.estimate.regression import Regression
from tau_dyn.estimate.weights import build_prior_rows, solve_scaled
from tau_dyn.exceptions import CannotAnswer, UnknownName
from tau_dyn.parameters import Parameters
from tau_dyn.results import Brief

MAX_RELATIVE_STDERR = 0.30
"""Relative standard error below which a parameter counts as determined."""


_DRIVE_INERTIA = ".armature"
"""End of the names of drive inertias."""
_REFIT_TOLERANCE = 1e-10
"""Relative singular value below which a direction of a refit is rounding."""


@dataclass(frozen=True, eq=False)
class Estimate(Brief):
    """A solved `Regression`.

    Attributes:
        regression: The problem.
        parameters: Values that predict best within physics, with `stderr` if the data identify a parameter alone.
        base: Base parameters of the data.
        beta: Their estimates (r,), after any constraint.
        beta_plain: Their least-squares estimates without constraints (r,).
        cov: Covariance of `beta_plain` (r, r), by autoregressive models of the residual.
        scatter: The same from the scatter of blocks (r, r); for each quantity, the larger error of the two counts.
        structural: Base parameters any motion could show; None if no such study was given.
        cond: Condition number of the base columns at unit norm.
        noise: Noise model of each output's residual.
        sigma: Residual deviation of each output (m,), the weights.
        moved: Names of parameters that a constraint holds away from the plain estimate, with the plain value.
        estimator: Name of the estimator that was used; see `identify/estimators.py`.
        warnings: Sentences about doubts in the estimation.
    """

    regression: Regression
    parameters: Parameters
    base: BaseParameters
    beta: np.ndarray
    beta_plain: np.ndarray
    cov: np.ndarray
    scatter: np.ndarray
    structural: BaseParameters | None
    cond: float
    noise: tuple[Autoregression, ...]
    sigma: np.ndarray
    moved: Mapping[str, float]
    estimator: str = "wls"
    warnings: tuple[str, ...] = ()

    @property
    def theta(self) -> np.ndarray:
        """All parameters (p,), in the regression's column order."""
        return self.parameters.values

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors of the base parameters (r,)."""
        return select_larger_stderr(self.cov, self.scatter)

    def stderr_of(self, weights: np.ndarray) -> float:
        """Return the standard error of `weights @ beta_plain`, weights (r,)."""
        return float(max(weights @ self.cov @ weights, weights @ self.scatter @ weights, 0.0) ** 0.5)

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the base parameters (r, r)."""
        scale = np.sqrt(np.outer(np.diag(self.cov), np.diag(self.cov)))
        return self.cov / np.where(scale > 0, scale, 1.0)

    def residuals(self) -> list[np.ndarray]:
        """Return measured minus predicted for each run (n, m)."""
        return self.regression.residuals(self.theta)

    def refit(self, outputs: Sequence[np.ndarray]) -> np.ndarray:
        """Return the least-squares base parameters (r,) for other outputs (n, m) of each run, with the same weights.

        Parameters measured beforehand have the same weight as in the estimate, and the target zero.
        """
        rows = self.stack_rows()
        targets = [(x / self.sigma)[run.usable] for run, x in zip(self.regression.runs, outputs, strict=True)]
        y = np.concatenate(targets)
        return solve_scaled(rows, np.concatenate([y, np.zeros(len(rows) - len(y))]), _REFIT_TOLERANCE)

    def stack_rows(self) -> np.ndarray:
        """Return the weighted base columns of usable samples, then rows of parameters measured beforehand (N + k, r)."""
        base, parameters = self.base, self.regression.parameters
        kept = [parameters.names.index(base.names[c]) for c in base.kept]
        rows = [(run.W[:, :, kept] / self.sigma[:, None])[run.usable] for run in self.regression.runs]
        known, _ = build_prior_rows(parameters.select(base.names))
        return np.concatenate([*rows, known[:, base.kept]])

    @cached_property
    def contained(self) -> tuple[dict[str, float], ...]:
        """The fixed drive inertias that each base parameter contains, with their factors.

        A rotor's reflected inertia `G^2 J` acts as `armature a`. If bodies give the same column, as the link behind the first
        joint of an arm does, no data separate the two. A single body that contains a drive inertia without a given value keeps
        its name.
        """
        parameters, base = self.regression.parameters, self.base
        drives = [k for k, p in enumerate(parameters) if not p.free and p.name.endswith(_DRIVE_INERTIA)]
        if not drives:
            return ({},) * base.rank
        R = self.regression.totals().R[:, :, :-1].reshape(-1, len(parameters))
        kept = [parameters.names.index(base.names[c]) for c in base.kept]
        K = find_contained(R, kept, drives)
        names = [parameters.names[k] for k in drives]
        given = [parameters[name].value != 0 for name in names]
        alone = base.alone[base.kept]
        return tuple(
            {name: float(x) for name, x, known in zip(names, row, given, strict=True) if x and (known or not own)}
            for row, own in zip(K, alone, strict=True)
        )

    def sum_contained(self, row: int) -> float:
        """Return the sum of the fixed drive inertias in a base parameter."""
        return sum(factor * self.regression.parameters[name].value for name, factor in self.contained[row].items())

    def expression(self, row: int) -> str:
        """Return a base parameter in words, with the fixed drive inertias that it contains."""
        return self.base.expression(row, self.contained[row])

    def identifiable(self, name: str) -> bool:
        """Return whether some motion could show this parameter by itself."""
        base = self.structural or self.base
        return name in base.names and bool(base.alone[base.names.index(name)])

    def determined(self, name: str) -> bool:
        """Return whether these data determine the parameter to within 30 % of its value."""
        p = self.parameters[name]
        return p.stderr is not None and p.stderr < MAX_RELATIVE_STDERR * abs(p.value)


def attach_stderr(parameters: Parameters, base: BaseParameters, stderr: np.ndarray) -> Parameters:
    """Attach standard errors to the parameters that are base parameters by themselves, and the origin of each value."""
    known = base.by_name(stderr)
    shared = {name for k, name in enumerate(base.names) if name not in known and base.depends_on(k)}
    origin = dict.fromkeys(known, "identified") | dict.fromkeys(shared, "one of many splits with the same forces")
    return parameters.update(
        {
            p.name: {"stderr": known.get(p.name), "origin": origin.get(p.name, p.origin), "split": p.name in shared}
            for p in parameters
        }
    )


_TOLERANCE = 1e-6
"""Largest relative error of a weight: base combinations are known to about 1e-9, published ones are often rounded."""


class ParameterSum(NamedTuple):
    """The value of a sum of parameters and its standard error."""

    value: float
    stderr: float


def combine_parameters(estimate: Estimate, weights: Mapping[str, float]) -> ParameterSum:
    """Return `sum of weight * parameter` from plain least squares, without bounds and physics, and its standard error.

    Args:
        estimate: A solved regression.
        weights: Factor of each parameter, by name; a fixed parameter counts with its value, as exact.

    Raises:
        UnknownName: A name that is no parameter.
        CannotAnswer: The data do not identify this sum.
    """
    base, parameters = estimate.base, estimate.parameters
    for name in weights:
        if name not in parameters:
            raise UnknownName("parameter", name, parameters.names)
    w = np.array([weights.get(name, 0.0) for name in base.names])
    kept, dropped = w[base.kept], w[base.dropped]
    off = np.abs(dropped - base.K.T @ kept)
    unseen = off > _TOLERANCE * (np.abs(dropped) + np.abs(base.K.T) @ np.abs(kept))
    if unseen.any():
        names = [base.names[c] for c in base.dropped[unseen]]
        text = " + ".join(f"{x:g}*{name}" for name, x in weights.items())
        raise CannotAnswer(
            "not_identifiable",
            f"the data do not identify {text}; what they see holds other shares of {', '.join(names)}",
            "ask for a base parameter's expression, or record a motion that separates these",
        )
    fixed = sum(x * parameters[name].value for name, x in weights.items() if name not in base.names)
    return ParameterSum(float(kept @ estimate.beta_plain) + fixed, estimate.stderr_of(kept))


_WIDE = 100.0
"""Prior standard deviation of a parameter without a prior, in its standard errors: the data alone determine it."""
_NEGLIGIBLE = 0.1
"""Change of a sum [standard errors] below which a term is left out: the parameter's possible error times its factor."""


@dataclass(frozen=True, eq=False)
class DeterminedCombinations:
    """Combinations with their values.

    Attributes:
        base: The leading parameter of each combination, and the factors of the others.
        contained: The fixed drive inertias that each combination contains, with their factors.
        values: Their values (k,), each in the unit of its first parameter.
        stderr: Their standard errors (k,).
    """

    base: BaseParameters
    contained: tuple[dict[str, float], ...]
    values: np.ndarray
    stderr: np.ndarray


def find_determined_combinations(estimate: Estimate, sizes: Mapping[str, float]) -> DeterminedCombinations | None:
    """Return the combinations that the data determine better than the robot file; None if they determine every base parameter.

    Args:
        estimate: The fit.
        sizes: Standard deviation of a parameter before the data, by name, in its unit; others have no prior.
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
    """Return each base parameter's standard deviation (r,) before the data, with independent terms of its sum."""
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
