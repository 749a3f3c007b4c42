r"""A fit that weighs each number as well as it was measured: generalised least squares from where a plain fit stands.

A camera measures depth ten times worse than what lies across, and far poses worse than near ones. `fit` weighs all
alike; with the device's covariance `S_k` of each pose the residuals are `S_k^-1/2 r_k` instead, and `cov = (sum J_k'
S_k^-1 J_k)^-1` times their mean square.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.residuals import FitState, Problem
from tau_dyn.exceptions import InputError

_STEPS = 20  # Gauss-Newton steps; bounds the time
_AT_REST = 1e-6
"""Longest last step, in standard errors."""


def refine(fitted: GeometryFit, covariance: np.ndarray) -> GeometryFit:
    """Return a fit with every pose weighed by its own covariance.

    Args:
        fitted: A fit with forward residuals.
        covariance: Of the measured numbers (N, m, m), as `Device.covariance` gives them; orientations are left out
            where the fit has none.

    Raises:
        InputError: Covariances that do not belong to these poses, or a fit with other residuals.
    """
    n, m = fitted.residuals.shape
    if fitted.kind != "forward":
        raise InputError(
            "unsupported", f"only forward residuals can be weighed by a device's covariance, not {fitted.kind} ones"
        )
    if covariance.ndim != 3 or len(covariance) != n or covariance.shape[1] < m or not np.isfinite(covariance).all():
        raise InputError("wrong_shape", f"the fit has {n} poses of {m} numbers, the covariances are {covariance.shape}")
    problem = Problem(fitted.geometry, fitted.poses, fitted.unknowns, fitted.kind, m == 6)
    root = np.linalg.cholesky(covariance[:, :m, :m])
    kept = np.flatnonzero(fitted.unknowns.free)[fitted.identifiability.kept]
    state, converged = fitted.state, False
    for _ in range(_STEPS):
        flat, r = _whitened(problem, state, root, kept)
        step = np.linalg.lstsq(flat, r, rcond=1e-13)[0]
        whole = np.zeros(len(fitted.unknowns.rows))
        whole[kept] = step
        state = problem.moved(state, whole)
        if np.linalg.norm(flat @ step) < _AT_REST * np.sqrt(len(kept)):
            converged = True
            break
    return _result(fitted, problem, state, root, kept, converged)


def _whitened(problem: Problem, state: FitState, root: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ok = state.ok
    columns = np.linalg.solve(root[ok], problem.columns(state)[ok][:, :, kept])
    r = np.linalg.solve(root[ok], problem.residuals(state)[ok][:, :, None])
    return columns.reshape(-1, len(kept)), r.ravel()


def _result(
    fitted: GeometryFit, problem: Problem, state: FitState, root: np.ndarray, kept: np.ndarray, converged: bool
) -> GeometryFit:
    flat, r = _whitened(problem, state, root, kept)
    own = np.linalg.pinv(flat.T @ flat, rcond=1e-14, hermitian=True) * float(r @ r) / max(len(r) - len(kept), 1)
    cov = np.zeros_like(fitted.cov)
    cov[np.ix_(fitted.identifiability.kept, fitted.identifiability.kept)] = own
    columns = np.zeros((*fitted.residuals.shape, len(kept)))
    columns[state.ok] = flat.reshape(int(state.ok.sum()), -1, len(kept))
    return replace(
        fitted, state=state, cov=cov, residuals=problem.residuals(state), columns=columns, converged=converged
    )
