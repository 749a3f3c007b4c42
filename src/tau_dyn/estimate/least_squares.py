r"""Weighted least squares on base parameters, each output weighted by its own noise.

    minimise  sum_j || (y_j - W_j theta) / sigma_j ||^2

`sigma_j` is output j's residual deviation; estimate and weights are iterated until they converge. A parameter known beforehand
with an uncertainty is one more row. Covariances hold under coloured noise (`covariance.py`), bounds and physics come after
(`physical_consistency.py`). Reference: Gautier & Poignet 2001, Extended Kalman filtering and weighted least squares dynamic
identification of robot. The algorithm uses the outputs' triangular factors (`regression.py`), so that the number of samples
does not matter; only the covariance needs the residuals themselves, run by run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.estimate.base_parameters import BaseParameters, find_base
from tau_dyn.estimate.covariance import Scores, estimate_covariance, select_larger_stderr
from tau_dyn.estimate.estimate import Estimate, attach_stderr
from tau_dyn.estimate.physical_consistency import PhysicalConstraints, solve_consistent
from tau_dyn.estimate.regression import Regression, RegressionRows
from tau_dyn.estimate.weights import build_prior_rows
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.parameters import Parameters

_MAX_ITERATIONS = 20  # of reweighting; bounds the time


def solve_least_squares(
    regression: Regression,
    *,
    physics: PhysicalConstraints | None = None,
    structural: BaseParameters | None = None,
    gains: Mapping[str, float] | None = None,
) -> Estimate:
    """Estimate the free parameters of a regression.

    Args:
        regression: The problem; fixed parameters keep their values, those with `prior_stderr` are measured beforehand.
        physics: Constraints that make a parameter vector physical; None for bounds alone. If no body can have the estimated
            inertia, drive inertias that it may contain are estimated, too.
        structural: Base parameters that any motion could show; they separate parameters that are not excited from those that are
            not identifiable.
        gains: Relative standard deviation of an output's scale (a motor constant), by output name; carried through.

    Raises:
        CannotAnswer: Fewer usable samples than parameters.
    """
    rows = _rows(regression)
    units = [p.unit for p in regression.parameters.select(rows.names)]
    base = find_base(np.concatenate([rows.W, rows.prior_W]), rows.names, units=units)
    if base.rank == 0 or rows.count.sum() <= base.rank:
        raise CannotAnswer(
            "too_little_data",
            f"only {rows.count.sum()} usable samples for {max(base.rank, 1)} parameters",
            "record a longer motion that moves every joint in both directions",
        )
    beta, sigma = _iterate(rows, base, len(regression.outputs))
    weighted, y = rows.weighted(sigma, base)
    R = np.asarray(np.linalg.qr(weighted, mode="r"))
    known = np.concatenate([rows.prior_W[:, base.kept], _gain_rows(regression, rows, weighted, y, gains or {})])
    scores = _scores(regression, rows, base, _full(regression.parameters, rows, base, beta), sigma)
    certainty = estimate_covariance(scores, regression.n_samples, R, known)
    constrained = solve_consistent(regression.parameters, base, beta, R, physics)
    if physics and physics.rotors and constrained.moved:
        freed = regression.parameters.update({name: {"free": True} for name in physics.rotors})
        wider = solve_least_squares(
            replace(regression, parameters=freed),
            physics=replace(physics, rotors=()),
            structural=structural,
            gains=gains,
        )
        if len(wider.moved) < len(constrained.moved):
            return wider
    stderr = select_larger_stderr(certainty.autoregressive, certainty.clustered)
    return Estimate(
        regression=regression,
        parameters=attach_stderr(constrained.parameters, base, stderr),
        base=base,
        beta=base.combine(constrained.parameters.select(base.names).values),
        beta_plain=beta,
        cov=certainty.autoregressive,
        scatter=certainty.clustered,
        structural=structural,
        cond=float(np.linalg.cond(weighted / np.linalg.norm(weighted, axis=0))),
        noise=certainty.models,
        sigma=sigma,
        moved=constrained.moved,
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of the free columns, fixed ones subtracted, and prior knowledge as rows of unit noise.

    An output's rows are those of its triangular factor, which is equivalent to all of its samples in least squares;
    `count` and `mean` of `y` are those of the samples.
    """

    names: tuple[str, ...]
    free: np.ndarray
    W: np.ndarray
    y: np.ndarray
    index: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    prior_W: np.ndarray
    prior_y: np.ndarray

    def weighted(self, sigma: np.ndarray, base: BaseParameters) -> tuple[np.ndarray, np.ndarray]:
        """Return all rows at unit noise, base columns only: (N, r) and (N,)."""
        scale = sigma[self.index]
        return (
            np.concatenate([self.W[:, base.kept] / scale[:, None], self.prior_W[:, base.kept]]),
            np.concatenate([self.y / scale, self.prior_y]),
        )


def _rows(regression: Regression) -> _Rows:
    parameters = regression.parameters
    free = parameters.free
    names = tuple(n for n, f in zip(parameters.names, free, strict=True) if f)
    totals = regression.totals()
    stacked, index = totals.R.reshape(-1, len(free) + 1), np.repeat(np.arange(len(totals.R)), len(free) + 1)
    fixed = np.concatenate([np.where(free, 0.0, -parameters.values), [1.0]])
    W, y, mean = stacked[:, :-1], stacked @ fixed, totals.sums @ fixed / np.maximum(totals.count, 1)
    return _Rows(names, free, W[:, free], y, index, totals.count, mean, *build_prior_rows(parameters.select(names)))


def _scores(regression: Regression, rows: _Rows, base: BaseParameters, theta: np.ndarray, sigma: np.ndarray) -> Scores:
    """Return a function that yields every run's weighted base columns and residuals, piece by piece."""
    columns = np.flatnonzero(rows.free)[base.kept]

    def runs() -> Iterator[Iterator[RegressionRows]]:
        for run in regression.rows():
            yield (x._replace(W=x.W[:, :, columns] / sigma[:, None], y=(x.y - x.W @ theta) / sigma) for x in run)

    return runs


def _iterate(rows: _Rows, base: BaseParameters, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Alternate between estimate and weights; return base estimates (r,) and each output's residual deviation."""
    seen = rows.count > 0

    def deviations(e: np.ndarray, mean: np.ndarray | float = 0.0) -> np.ndarray:
        squares = np.array([np.sum(e[rows.index == k] ** 2) for k in range(n_outputs)])
        return np.where(seen, np.sqrt(np.maximum(squares / np.maximum(rows.count, 1) - np.square(mean), 0.0)), 1.0)

    sigma = deviations(rows.y, rows.mean)
    sigma = np.where(sigma > 0, sigma, 1.0)
    floor = 1e-9 * sigma
    beta = np.zeros(base.rank)
    for _ in range(_MAX_ITERATIONS):
        before = sigma
        W, y = rows.weighted(sigma, base)
        norm = np.linalg.norm(W, axis=0)
        beta = np.linalg.lstsq(W / norm, y, rcond=None)[0] / norm
        e = rows.y - rows.W[:, base.kept] @ beta
        share = base.rank / max(int(rows.count.sum()), 1)
        spread = np.where(seen, deviations(e) / np.sqrt(1 - share), 1.0)
        sigma = np.maximum(spread, floor)
        if np.allclose(sigma, before, rtol=1e-6):
            break
    return beta, sigma


def _full(parameters: Parameters, rows: _Rows, base: BaseParameters, beta: np.ndarray) -> np.ndarray:
    """Return a full vector that predicts as the base estimates do (the dropped columns at zero)."""
    theta = parameters.values
    free = np.zeros(len(rows.names))
    free[base.kept] = beta
    theta[rows.free] = free
    return theta


def _gain_rows(
    regression: Regression, rows: _Rows, weighted: np.ndarray, y: np.ndarray, gains: Mapping[str, float]
) -> np.ndarray:
    """Return one row (r,) for each uncertain output scale: `W' y` of that output times the scale's relative deviation."""
    found = [np.zeros((0, weighted.shape[1]))]
    for k, output in enumerate(regression.outputs):
        mine = np.flatnonzero(rows.index == k)
        found.append(gains.get(output, 0.0) * (weighted[mine].T @ y[mine])[None])
    return np.concatenate(found)
