r"""Instrumental variables: columns without noise replace those on the left of the normal equations.

    Z' Sigma^-1 (y - W theta) = 0,   cov = J^-1 (Z' Sigma^-1 Omega Sigma^-1 Z) J^-T,   J = Z' Sigma^-1 W

Least squares has Z = W, and is biased if W contains noise that y - W theta contains, too. With the noise-free columns as Z and
the noise's own covariance as Sigma, no consistent estimator with the same knowledge is more precise. Rows come whitened by
`Sigma`; `Omega` is estimated from the whitened residual (`covariance.py`), so that the standard error stays valid if `Sigma` is
not quite right. Reference: Soderstrom & Stoica 1983, Instrumental Variable Methods for System
Identification.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.estimate.covariance import estimate_score_covariance, select_larger_stderr
from tau_dyn.estimate.estimate import Estimate, attach_stderr
from tau_dyn.estimate.physical_consistency import PhysicalConstraints, solve_consistent
from tau_dyn.estimate.weights import build_prior_rows
from tau_dyn.exceptions import CannotAnswer

MIN_RECIPROCAL_CONDITION = 1e-8
"""Reciprocal condition of `J` at unit scale below which instruments do not separate the parameters."""

_ROWS = 400
"""Equations multiplied at once."""


@dataclass(frozen=True, eq=False)
class WhiteRows:
    """White equations of one stretch, base columns only.

    Attributes:
        t: Time (n,) [s].
        Z: Instruments (n, m, r).
        W: Columns (n, m, r).
        y: Forces minus the contribution of fixed parameters (n, m).
        shares: Contribution of each output's force to `y` (n, m, m), for uncertain gains; or None.
        keep: Which equations count (n, m).
    """

    t: np.ndarray
    Z: np.ndarray
    W: np.ndarray
    y: np.ndarray
    shares: np.ndarray | None
    keep: np.ndarray


@dataclass(frozen=True, eq=False)
class InstrumentalSolution:
    """Base estimates (r,), `J` (r, r) and whitened residuals (n, m) of each stretch."""

    beta: np.ndarray
    J: np.ndarray
    residuals: tuple[np.ndarray, ...]


def solve_instrumental_variables(first: Estimate, rows: Sequence[WhiteRows]) -> InstrumentalSolution:
    """Return base estimates from white rows and prior knowledge.

    Args:
        first: First estimate, with base parameters and prior knowledge.
        rows: Stretches, never joined.

    Raises:
        CannotAnswer: The instruments do not separate the parameters.
    """
    known, prior = _known(first)
    J = known.T @ known + sum(_product(x.Z, x.W) for x in rows)
    moment = known.T @ prior + sum(_product(x.Z, x.y[:, :, None])[:, 0] for x in rows)
    scale = np.sqrt(np.abs(np.diag(J)))
    if not np.all(scale > 0) or 1 / np.linalg.cond(J / np.outer(scale, scale)) < MIN_RECIPROCAL_CONDITION:
        raise _blind()
    beta = np.linalg.solve(J / np.outer(scale, scale), moment / scale) / scale
    return InstrumentalSolution(beta, J, tuple(x.y - x.W @ beta for x in rows))


def estimate_of(
    first: Estimate,
    rows: Sequence[WhiteRows],
    solution: InstrumentalSolution,
    *,
    physics: PhysicalConstraints | None = None,
    gains: Mapping[str, float] | None = None,
    factor: float = 1.0,
) -> Estimate:
    """Return the estimate with its covariance, held within physics, on the regression of a first one.

    Args:
        first: Weighted least squares, with the regression for residuals, base parameters and bounds.
        rows: Stretches.
        solution: Result of `solve_instrumental_variables`.
        physics: Bodies to keep physical.
        gains: Relative standard deviation of an output's scale, by output.
        factor: Ratio of the covariance to that with fixed weights.

    Raises:
        CannotAnswer: The instruments are almost uncorrelated with the columns.
    """
    coloured, scattered = estimate_instrumental_covariance(first, rows, solution, gains or {}, factor)
    try:
        R = np.linalg.cholesky(0.5 * (solution.J + solution.J.T)).T
    except np.linalg.LinAlgError:  # columns and instruments of different motions
        raise _blind() from None
    held = solve_consistent(first.regression.parameters, first.base, solution.beta, R, physics)
    stderr = select_larger_stderr(coloured, scattered)
    return replace(
        first,
        parameters=attach_stderr(held.parameters, first.base, stderr),
        beta=first.base.combine(held.parameters.select(first.base.names).values),
        beta_plain=solution.beta,
        cov=coloured,
        scatter=scattered,
        moved=held.moved,
    )


def estimate_instrumental_covariance(
    first: Estimate,
    rows: Sequence[WhiteRows],
    solution: InstrumentalSolution,
    gains: Mapping[str, float],
    factor: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances (r, r) from the residual's correlation and from the scatter of blocks; see `estimate_of`."""
    known, _ = _known(first)
    extra = [known]
    for k, output in enumerate(first.regression.outputs):
        if gains.get(output):
            share = sum(_product(x.Z, x.shares[k][:, :, None])[:, 0] for x in rows if x.shares is not None)
            extra.append(gains[output] * np.asarray(share)[None])
    sure = np.concatenate(extra)
    middles = estimate_score_covariance(
        [x.t for x in rows], [x.Z for x in rows], solution.residuals, [x.keep for x in rows]
    )
    turn = np.linalg.inv(solution.J)
    coloured, scattered = (turn @ (factor**2 * middle + sure.T @ sure) @ turn.T for middle in middles)
    return coloured, scattered


def _blind() -> CannotAnswer:
    return CannotAnswer(
        "not_identifiable",
        "the instruments do not separate the parameters",
        "use --estimator wls, or log the references (q_ref_J) that the controller really got",
    )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum over all equations of outer products: (n, m, r), (n, m, k) -> (r, k)."""
    total = np.zeros((a.shape[2], b.shape[2]))
    for i in range(0, len(a), _ROWS):  # short products stay in the processor's cache and on one thread
        part = slice(i, i + _ROWS)
        total += a[part].reshape(-1, a.shape[2]).T @ b[part].reshape(-1, b.shape[2])
    return total


def _known(first: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters measured beforehand as rows of unit noise: base columns (k, r) and values (k,)."""
    rows, values = build_prior_rows(first.regression.parameters.select(first.base.names))
    return rows[:, first.base.kept], values
