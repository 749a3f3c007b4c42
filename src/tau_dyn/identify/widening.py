r"""Covariance of an estimate, and the factors by which model errors widen it.

In directions in which 2 s blocks scatter more than autoregressive noise, their covariance is used, shrunk towards its mean as so
few blocks require (oracle approximating shrinkage). Logs that scatter beyond that (Birge), physical constraints that move the
estimate, and a robot file that the logs contradict each give a factor on variances. Reference: Birge 1932; Chen, Wiesel, Eldar
& Hero 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, stats

from tau_dyn.estimate import Estimate, InertialBody, assign_blocks, pseudo_inertia
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import BodyPrior

_SIGNIFICANCE_LEVEL = 0.01  # at which physics or another log contradicts the errors
_ACTIVE = 1e-6  # of a pseudo-inertia's trace: an eigenvalue below it is held by physics


@dataclass(frozen=True)
class Widening:
    """Factors on variances for model errors; 1 without any.

    Attributes:
        logs: Scatter of whole logs' scores divided by its prediction from the errors; needs three logs or more.
        physics: Squared distance of the plain estimate from the consistent set over its expectation, if it is significant.
        prior: Factor on the variances of the robot file's values at which they agree with the logs.
    """

    logs: float = 1.0
    physics: float = 1.0
    prior: float = 1.0

    @property
    def data(self) -> float:
        """Factor on the covariance of the estimate."""
        return max(self.logs, self.physics)

    def to_dict(self) -> dict[str, float]:
        """Return the contract's form."""
        return {"logs": self.logs, "physics": self.physics, "prior": self.prior}


def compute_data_covariance(estimate: Estimate) -> np.ndarray:
    """Return one covariance (r, r) of the base parameters: autoregressive, enlarged in directions of larger block scatter.

    In coordinates in which the autoregressive covariance is the identity, that of the 2 s blocks has the eigenvalues of a Wishart
    matrix of few blocks. They are shrunk towards their mean, and those above one are used.
    """
    scale = np.sqrt(np.diag(estimate.cov))
    L = linalg.cholesky(_regular(estimate.cov / np.outer(scale, scale)), lower=True) * scale[:, None]
    inner = linalg.solve_triangular(L, linalg.solve_triangular(L, estimate.scatter, lower=True).T, lower=True)
    blocks = _count_blocks(estimate)
    eigenvalues, vectors = np.linalg.eigh(_shrink((inner + inner.T) / 2, blocks))
    root = L @ vectors * np.sqrt(np.maximum(eigenvalues, 1.0))
    return root @ root.T


def _regular(correlation: np.ndarray) -> np.ndarray:
    """Return a correlation matrix without eigenvalues that rounding made zero or negative."""
    eigenvalues, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    return vectors * np.maximum(eigenvalues, 1e-12 * eigenvalues[-1]) @ vectors.T


def _shrink(S: np.ndarray, n: int) -> np.ndarray:
    """Return a covariance (r, r) of n observations shrunk towards its mean eigenvalue (Chen et al. 2010, OAS)."""
    r, mean = len(S), np.trace(S) / len(S)
    squares = float(np.sum(S**2))
    above = (1 - 2 / r) * squares + np.trace(S) ** 2
    below = (n + 1 - 2 / r) * (squares - np.trace(S) ** 2 / r)
    share = 1.0 if below <= 0 else min(1.0, above / below)
    return (1 - share) * S + share * mean * np.eye(r)


def _count_blocks(estimate: Estimate) -> int:
    """Return the number of 2 s blocks in the scatter."""
    count = 0
    for run in estimate.regression.rows():
        start, seen = None, set()
        for rows in run:
            start = rows.t[0] if start is None else start
            seen |= set(assign_blocks(rows.t[rows.usable.any(axis=1)] - start).tolist())
        count += len(seen)
    return max(count, 1)


def measure_logs(estimate: Estimate, C: np.ndarray) -> float:
    """Return the scatter of logs' scores over its prediction (Birge ratio); 1 for fewer than three logs or less scatter."""
    regression, base = estimate.regression, estimate.base
    names = [run.name for run in regression.runs]
    if estimate.estimator != "wls" or regression.everything is not None or len(set(names)) < 3:
        return 1.0
    kept = [regression.parameters.names.index(base.names[c]) for c in base.kept]
    theta = _unconstrained(estimate)
    score, J = {name: np.zeros(base.rank) for name in names}, np.zeros((base.rank, base.rank))
    for run in regression.runs:
        W = (run.W[:, :, kept] / estimate.sigma[:, None])[run.usable]
        e = ((run.y - run.W @ theta) / estimate.sigma)[run.usable]
        score[run.name] += W.T @ e
        J += W.T @ W
    K = len(score)
    bend = sum(np.outer(s, s) for s in score.values()) * K / (K - 1)
    scale = np.sqrt(np.diag(J))
    inverse = np.linalg.pinv(J / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    scatter = inverse @ bend @ inverse
    return max(1.0, float(np.trace(np.linalg.solve(C, scatter))) / base.rank)


def _unconstrained(estimate: Estimate) -> np.ndarray:
    """Return a full vector (p,) of the regression that predicts as the plain base estimates do."""
    names = estimate.regression.parameters.names
    theta = estimate.parameters.values
    theta[[names.index(n) for n in estimate.base.names]] = 0.0
    theta[[names.index(estimate.base.names[c]) for c in estimate.base.kept]] = estimate.beta_plain
    return theta


def measure_physics(estimate: Estimate, C: np.ndarray, bodies: list[InertialBody]) -> float:
    """Return the effect of physics on the estimate: chi-square over its expectation, if it is significant; else 1."""
    moved = estimate.beta - estimate.beta_plain
    active = sum(p.free and p.at_bound for p in estimate.parameters)
    active += sum(estimate.parameters.is_at_bound(pair[0]) for pair in estimate.parameters.friction_sums)
    for body in bodies:
        J = pseudo_inertia(body.map @ estimate.parameters.select(body.parameters).values)
        active += int(np.sum(np.linalg.eigvalsh(J) < _ACTIVE * max(float(np.trace(J)), 1e-12)))
    if not active:
        return 1.0
    distance = float(moved @ np.linalg.solve(C, moved))
    return distance / active if stats.chi2.sf(distance, active) < _SIGNIFICANCE_LEVEL else 1.0


def list_prior_stderr(model: Model, estimate: Estimate, nominal: Parameters) -> np.ndarray:
    """Return each free column's standard error in the robot file (q,), inf for columns without a prior.

    Parameters that were measured beforehand are in the data already and have inf here, too.
    """
    told = BodyPrior.of(model.robot).rough
    known = [nominal[n].prior_stderr is None and told.get(n, 0.0) > 0 for n in estimate.base.names]
    return np.array([told[n] if ok else np.inf for n, ok in zip(estimate.base.names, known, strict=True)])


def combine_free(estimate: Estimate) -> np.ndarray:
    """Return the map from free columns to base parameters (r, q)."""
    base = estimate.base
    B = np.zeros((base.rank, len(base.names)))
    B[range(base.rank), base.kept] = 1.0
    B[:, base.dropped] = base.K
    return B


def measure_prior(estimate: Estimate, C: np.ndarray, nominal: Parameters, sizes: np.ndarray) -> float:
    """Return the factor on the file's variances at which its values agree with the logs; 1 if they agree."""
    B, told = combine_free(estimate), np.isfinite(sizes)
    root = linalg.cholesky(C, lower=True)
    A = linalg.solve_triangular(root, B, lower=True)
    y = linalg.solve_triangular(root, estimate.beta_plain, lower=True) - A @ np.where(
        told, nominal.select(estimate.base.names).values, 0
    )
    free = A[:, ~told & B.any(axis=0)]
    rest = (
        linalg.null_space((free / np.maximum(np.linalg.norm(free, axis=0), 1e-300)).T) if free.size else np.eye(len(y))
    )
    if not rest.shape[1] or not told.any():
        return 1.0
    eigenvalues, vectors = np.linalg.eigh(rest.T @ (A[:, told] * sizes[told] ** 2) @ A[:, told].T @ rest)
    squares = (vectors.T @ rest.T @ y) ** 2

    def excess(log_factor: float) -> float:
        return float(np.sum(squares / (1 + np.exp(log_factor) * np.maximum(eigenvalues, 0.0)))) / len(squares) - 1

    if excess(0.0) <= 0 or excess(30.0) >= 0:
        return 1.0
    return float(np.exp(optimize.brentq(excess, 0.0, 30.0, xtol=1e-6)))  # type: ignore[arg-type]
