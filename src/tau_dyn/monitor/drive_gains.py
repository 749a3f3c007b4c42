r"""Comparison of the joints: does every drive measure the same payload?

    tau_j = Y_j theta_j + [loaded] (1 + g_j) L_j pi,     j = 1 .. na joints

`L_j pi` is the force of the payload at joint `j`. Every joint has its own base parameters and friction, so a wrong scale of its
force changes only `g_j`. Only ratios of the factors `1 + g_j` are identifiable: a common factor is a heavier payload. They are
estimated by alternating least squares on the joints' triangular factors. Their standard errors are those of the linear problem
at the solution (`estimate/covariance.py`), with one joint as the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from tau_dyn.estimate import Estimate, Regression, solve_least_squares
from tau_dyn.identify import compute_contrast_p_value
from tau_dyn.parameters import Parameter, Parameters

_ROUNDING = 1e-12
"""Norm of a column, relative to the largest, below which it is rounding; `estimate/base_parameters.py` has the same bound."""
_RANK = 1e-7
"""Singular value of unit columns, relative to the largest, below which a combination counts as dependent."""
_MIN_INFORMATION = 0.01
"""Smallest share of the information about the payload with which a joint gets its own factor."""
_ITERATIONS = 30
"""Largest number of iterations of alternating least squares; factors of 1.4 converge within ten."""


@dataclass(frozen=True)
class DriveGains:
    """The payload's mass as each joint measures it.

    Attributes:
        joints: Joints that are loaded by the payload.
        factors: Mass by each joint over the mass by the first (k,).
        stderr: Standard errors (k,); zero for the first, the reference.
        p_value: p-value of the hypothesis that all drives have equal factors.
    """

    joints: tuple[str, ...]
    factors: np.ndarray
    stderr: np.ndarray
    p_value: float

    @property
    def largest_difference(self) -> float:
        """Largest factor over the smallest, minus one."""
        return float(self.factors.max() / self.factors.min() - 1)


def compare_drives(estimate: Estimate, payload: tuple[str, ...]) -> DriveGains | None:
    """Return the factors between the joints; None if the payload loads fewer than two.

    Args:
        estimate: A payload's estimate, its columns in the loaded runs alone.
        payload: Names of its ten parameters.
    """
    regression = estimate.regression
    names = regression.parameters.names
    mine = [names.index(name) for name in payload]
    others = [k for k in range(len(names)) if k not in mine]
    totals, pi = regression.totals().R, estimate.parameters.select(payload).values
    bases = [_find_basis(R[:, others]) for R in totals]
    left = [
        _project_out(R[:, others] @ V, R[:, [*mine, -1]]) / s
        for R, V, s in zip(totals, bases, estimate.sigma, strict=True)
    ]
    information = np.array([float(np.sum((rows[:, :-1] @ pi) ** 2)) for rows in left])
    felt = [int(j) for j in np.argsort(-information) if information[j] > _MIN_INFORMATION * information.sum()]
    if len(felt) < 2:
        return None
    factors, pi = _alternate([left[j] for j in felt], pi)
    if not np.all(factors > 0):
        return None
    linear = _linearise(regression, bases, others, mine, felt, factors, pi)
    solved = solve_least_squares(linear)
    kept = [solved.base.names[k] for k in solved.base.kept]
    own = [f"factor.{regression.outputs[j]}" for j in felt[1:]]
    if not all(name in kept and solved.base.alone[solved.base.names.index(name)] for name in own):
        return None
    rows = np.eye(len(kept))[[kept.index(name) for name in own]]
    final = np.array([1.0, *(solved.parameters[name].value for name in own)])
    p_value = compute_contrast_p_value(_shift(solved, rows), rows)
    stderr = np.array([0.0, *(solved.stderr_of(row) for row in rows)])
    return DriveGains(tuple(regression.outputs[j] for j in felt), final, stderr, 1.0 if p_value is None else p_value)


def _shift(solved: Estimate, rows: np.ndarray) -> Estimate:
    """Return the estimate with factors minus one, which are zero for equal drives."""
    return replace(solved, beta_plain=solved.beta_plain - rows.sum(axis=0))


def _find_basis(columns: np.ndarray) -> np.ndarray:
    """Return combinations (p, r) of columns (n, p) that are independent.

    LAPACK's divide and conquer (`gesdd`) may not converge on triangular factors of many dependent columns; `gesvd` does.
    """
    norm = np.linalg.norm(columns, axis=0)
    unit = np.where(norm > _ROUNDING * norm.max(initial=0.0), norm, np.inf)
    _, s, Vt = linalg.svd(columns / unit, full_matrices=False, lapack_driver="gesvd")
    return Vt[s > _RANK * s.max(initial=1e-300)].T / unit[:, None]


def _project_out(B: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the residual of columns (n, k) after projection on others (n, r)."""
    Q, _ = np.linalg.qr(B)
    return C - Q @ (Q.T @ C)


def _alternate(left: list[np.ndarray], pi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return factors (k,), the first one, and the payload (10,) that fit rows `[L y]` (n, 11) of each joint."""
    factors = np.ones(len(left))
    for _ in range(_ITERATIONS):
        predicted = [rows[:, :-1] @ pi for rows in left]
        factors = np.array([float(x @ rows[:, -1] / (x @ x)) for x, rows in zip(predicted, left, strict=True)])
        factors = factors / factors[0]
        L = np.concatenate([f * rows[:, :-1] for f, rows in zip(factors, left, strict=True)])
        norm = np.linalg.norm(L, axis=0)
        unit = np.where(norm > 0, norm, 1.0)
        pi = np.linalg.lstsq(L / unit, np.concatenate([rows[:, -1] for rows in left]), rcond=_RANK)[0] / unit
    return factors, pi


def _linearise(
    regression: Regression,
    bases: list[np.ndarray],
    others: list[int],
    mine: list[int],
    felt: list[int],
    factors: np.ndarray,
    pi: np.ndarray,
) -> Regression:
    """Return the problem `y + f L pi = V z + f L pi + f' L pi` in the payload and the factors, around given values."""
    outputs = [regression.outputs[j] for j in felt]
    sizes = [bases[j].shape[1] for j in felt]
    starts = np.cumsum([0, *sizes])
    ten, first = starts[-1], starts[-1] + len(mine)
    runs = []
    for run in regression.runs:
        W = np.zeros((len(run.t), len(felt), first + len(felt) - 1))
        y = run.y[:, felt].copy()
        for k, j in enumerate(felt):
            W[:, k, starts[k] : starts[k + 1]] = run.W[:, j, others] @ bases[j]
            W[:, k, ten:first] = factors[k] * run.W[:, j, mine]
            if k:
                W[:, k, first + k - 1] = run.W[:, j, mine] @ pi
                y[:, k] += factors[k] * (run.W[:, j, mine] @ pi)
        usable = run.usable[:, felt]
        runs.append(replace(run, W=W, W_all=W, y=y, y_all=y, usable=usable))
    names = [f"base{k}.{joint}" for joint, n in zip(outputs, sizes, strict=True) for k in range(n)]
    names += [f"payload.{k}" for k in range(len(mine))] + [f"factor.{joint}" for joint in outputs[1:]]
    parameters = Parameters(Parameter(name, 0.0, "1") for name in names)
    units = tuple(regression.units[j] for j in felt)
    return Regression(parameters, tuple(outputs), units, tuple(runs), regression.preparation)
