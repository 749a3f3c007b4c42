r"""Nonlinear least squares: Gauss-Newton with Levenberg's damping, for vectors and for whatever else a step can move.

    minimise  sum_i rho(|r_i(theta)|) + sum_k ((theta_k - prior_k) / s_k)^2,   r_i = (measured - predicted)_i / stderr_i

`descend` is the loop. A problem says how it looks linearised, how a state moves by a step and what a move gains, so
rotations, balanced models and normal equations solved by blocks fit in. `fit_nonlinear` does the same for a vector of
parameters, with priors, bounds and weights against outliers. Directions that neither data nor prior tell are not moved along.

The loop is not `scipy.optimize.least_squares`, which knows vectors, dense or sparse derivatives and element-wise losses only.
A bundle adjustment of 2 cameras and 40 plates (8,640 residuals, 262 unknowns) takes 0.05 s with plates eliminated block by
block; SciPy takes 3.7 s dense (`trf`, `lm`) and 2.1 s sparse (`lsmr`, a worse optimum), 0.5 s of it for the derivatives.
Reference: Nocedal & Wright 2006, 10.3; Huber & Ronchetti 2009, 7.

Linear least squares about one state, factored once for every damping, with blind directions left alone and bounds kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from tau_dyn.estimate.weights import (
    LOSSES,
    compute_loss,
    compute_loss_covariance_factor,
    compute_robust_weights,
    estimate_distance_scale,
)
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.parameters import Parameters

RANK_TOLERANCE = 1e-12  # of the largest singular value: directions below it are blind
MIN_SHARE = 1e-6  # of a blind direction that makes a parameter undetermined


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """`columns @ step = residuals` in least squares, factored once for every damping.

    Attributes:
        scales: Unit of each unknown (p,); damping weighs steps in these units.
        q: Orthonormal basis (rows, p) of the columns, None where nobody asked for it.
        u: Its turn to singular vectors (p, p).
        values: Singular values of the scaled columns (p,), largest first.
        v: Directions of the scaled unknowns (p, p), in columns.
        target: The residuals along each (p,).
        tolerance: Of the largest singular value, below which a direction is blind.
    """

    scales: np.ndarray
    q: np.ndarray
    u: np.ndarray
    values: np.ndarray
    v: np.ndarray
    target: np.ndarray
    tolerance: float

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step (p,) and the rms change of the residuals that it predicts."""
        s = self.values[: self.rank]
        along = s / (s**2 + damping) * self.target[: self.rank]
        size = float(np.linalg.norm(s * along)) / max(len(self.q), 1) ** 0.5
        return self.scales * (self.v[:, : self.rank] @ along), size

    @property
    def rank(self) -> int:
        """Number of directions that the columns tell."""
        return int(np.sum(self.values > self.tolerance * self.values.max(initial=0.0)))

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the step (p, p) for residuals of unit noise; nothing along blind directions."""
        root = self.scales[:, None] * self.v[:, : self.rank] / self.values[: self.rank]
        return root @ root.T

    @property
    def leverage(self) -> np.ndarray:
        """Diagonal of the hat matrix (rows,)."""
        return np.sum((self.q @ self.u[:, : self.rank]) ** 2, axis=1)

    @property
    def undetermined(self) -> np.ndarray:
        """Which unknowns have a part in a blind direction (p,)."""
        return np.any(np.abs(self.v[:, self.rank :]) > MIN_SHARE, axis=1)


def factor_system(
    columns: np.ndarray, residuals: np.ndarray, scales: np.ndarray, tolerance: float = RANK_TOLERANCE
) -> LinearSystem:
    """Factor a linear least-squares problem.

    Args:
        columns: What a unit of each unknown explains (rows, p).
        residuals: What is to be explained (rows,).
        scales: Unit of each unknown (p,).
        tolerance: Of the largest singular value, below which a direction is blind.
    """
    q, triangle = np.linalg.qr(columns * scales)
    u, values, vt = np.linalg.svd(triangle, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(vt) - len(values))])
    target = np.concatenate([u.T @ (q.T @ residuals), np.zeros(len(vt) - u.shape[1])])
    return LinearSystem(scales, q, u, values, vt.T, target, tolerance)


@dataclass(frozen=True, eq=False)
class BoundedSystem:
    """A linear system whose unknowns may not leave their bounds: those that press against one are held."""

    rows: np.ndarray
    target: np.ndarray
    scales: np.ndarray
    at_lower: np.ndarray
    at_upper: np.ndarray
    tolerance: float

    def held(self) -> np.ndarray:
        """Return which unknowns (f,) stand at a bound and press outwards."""
        slope = self.rows.T @ self.target
        return (self.at_lower & (slope <= 0)) | (self.at_upper & (slope >= 0))

    @cached_property
    def free(self) -> LinearSystem:
        """The system of the others."""
        return self._without(self.held())

    def _without(self, held: np.ndarray) -> LinearSystem:
        return factor_system(self.rows[:, ~held], self.target, self.scales[~held], self.tolerance)

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return a step (f,) and the change that it predicts relative to the residuals."""
        held, system, step = self.held(), self.free, np.zeros(len(self.scales))
        while True:
            step[~held], size = system.step(damping)
            outwards = ~held & ((self.at_lower & (step < 0)) | (self.at_upper & (step > 0)))
            if not outwards.any():
                return step, size / max(float(np.sqrt(np.mean(self.target**2))), 1e-300)
            held, step = held | outwards, np.zeros(len(self.scales))
            system = self._without(held)


State = TypeVar("State")

MAX_NOISE_ROUNDS = 15  # bounds the time of a fit whose noise does not settle
MAX_NOISE_CHANGE = 1e-2  # of the noise in the last round: a hundredth of the standard errors
DIFFERENCED_RANK_TOLERANCE = 1e-8  # of the largest singular value, for differenced derivatives, which are good to 1e-10


class LinearisedProblem(Protocol):
    """A problem about one state."""

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return a step and its size, in the unit of `DescentRules.small_step`."""
        ...


class LeastSquaresProblem(Protocol[State]):
    """What `descend` asks of a problem."""

    def linearise(self, state: State) -> LinearisedProblem:
        """Return the problem about a state."""
        ...

    def move(self, state: State, step: np.ndarray) -> State:
        """Return the state after a step."""
        ...

    def gain(self, state: State, trial: State) -> float:
        """Return by how much the cost falls from a state to another; minus infinity or nan where that may not be visited."""
        ...


@dataclass(frozen=True)
class DescentRules:
    """When to stop, and how to damp.

    Attributes:
        max_steps: Most accepted steps.
        small_step: Size below which a step is the last.
        small_gain: Gain below which a step counts as idle.
        patience: Idle steps in a row that end the descent.
        damping: At the start; 0 begins with a whole Gauss-Newton step.
        first_damping: The smallest one above 0.
        growth: Factor of the damping after a trial that gains nothing; its inverse after a step at the first trial.
        max_trials: Dampings tried before the state counts as a minimum.
    """

    max_steps: int = 100
    small_step: float = 1e-8
    small_gain: float = 1e-13
    patience: int = 1
    damping: float = 0.0
    first_damping: float = 1e-3
    growth: float = 8.0
    max_trials: int = 20


@dataclass(frozen=True, eq=False)
class Descent(Generic[State]):
    """Where a descent ended.

    Attributes:
        state: The best state.
        steps: Accepted steps.
        trials: Steps tried.
        reason: `small_step`, `small_gain`, `no_descent` (no damping led further down) or `max_steps`.
    """

    state: State
    steps: int
    trials: int
    reason: str

    @property
    def converged(self) -> bool:
        """Whether it came to rest."""
        return self.reason != "max_steps"


def descend(
    problem: LeastSquaresProblem[State],
    state: State,
    rules: DescentRules = DescentRules(),
    progress: Callable[[int, float], None] = lambda step, gain: None,
) -> Descent[State]:
    """Walk down from a state.

    Args:
        problem: What to make small.
        state: Where to start.
        rules: When to stop, and how to damp.
        progress: Told the number of every accepted step and what it gained.
    """
    damping, idle, trials = rules.damping, 0, 0
    for steps in range(rules.max_steps):
        system, begun = problem.linearise(state), damping
        for _ in range(rules.max_trials):
            step, size = system.step(damping)
            trial = problem.move(state, step)
            gain = problem.gain(state, trial)
            trials += 1
            if gain >= 0:
                break
            if size < rules.small_step:
                return Descent(state, steps, trials, "small_step")
            damping = max(rules.growth * damping, rules.first_damping)
        else:
            return Descent(state, steps, trials, "no_descent")
        state, idle = trial, idle + 1 if gain < rules.small_gain else 0
        progress(steps + 1, gain)
        if size < rules.small_step:
            return Descent(state, steps + 1, trials, "small_step")
        if idle == rules.patience:
            return Descent(state, steps + 1, trials, "small_gain")
        if damping == begun:
            damping = damping / rules.growth if damping > rules.first_damping else 0.0
    return Descent(state, rules.max_steps, trials, "max_steps")


@dataclass(frozen=True, eq=False)
class NonlinearEstimate:
    """A vector of parameters fitted to measurements.

    Attributes:
        parameters: Values, with `stderr` where the data or a prior tell a parameter alone.
        cov: Covariance (f, f) of the free parameters, in their order; nothing along blind directions.
        residuals: Measured minus predicted (N, m).
        weights: Of the measurements (N,), 1 without a robust loss.
        noise: Standard deviation of a residual whose `stderr` is 1.
        cost: The minimum.
        rank: Number of directions that data and priors tell.
        steps: Accepted steps.
        reason: Why the last descent ended, as in `Descent`; `noise` where the noise did not settle.
    """

    parameters: Parameters
    cov: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    noise: float
    cost: float
    rank: int
    steps: int
    reason: str

    @property
    def converged(self) -> bool:
        """Whether values and noise came to rest."""
        return self.reason not in ("max_steps", "noise")


def fit_nonlinear(
    residuals: Callable[[np.ndarray], np.ndarray],
    start: Parameters,
    *,
    jacobian: Callable[[np.ndarray], np.ndarray] | None = None,
    stderr: np.ndarray | float = 1.0,
    noise: float | None = None,
    loss: str = "none",
    rules: DescentRules = DescentRules(),
    progress: Callable[[int, float], None] = lambda step, gain: None,
) -> NonlinearEstimate:
    """Fit parameters to measurements.

    Args:
        residuals: Takes all parameters (p,) to measured minus predicted, (N,) or (N, m): a row is one measurement. Not finite
            where the model has no answer; such values are not visited.
        start: Where to start, with bounds, priors (`prior_stderr` about the starting value) and what is free.
        jacobian: Takes all parameters to the residuals' derivative (N, p) or (N, m, p); central differences without one.
        stderr: Standard deviations of the residuals, relative to each other; broadcasts against them.
        noise: What these standard deviations are to be multiplied by; None estimates it, 1 takes them as they are.
        loss: `none`, or against bad measurements `huber` or `biweight`.
        rules: When to stop, and how to damp.
        progress: Told the number of every accepted step and what it gained, relative to the cost.

    Raises:
        InputError: Nothing is free, or the residuals at the start are not finite.
        UnknownName: No such loss.
    """
    if loss not in LOSSES:
        raise UnknownName("loss", loss, LOSSES)
    if not start.free.any():
        raise InputError("invalid_value", "no parameter is free")
    first = np.asarray(residuals(start.values), float)
    if not np.isfinite(first).all():
        raise InputError("invalid_value", "the residuals at the starting values are not finite")
    problem = _VectorProblem(residuals, jacobian, start, np.broadcast_to(stderr, first.shape), loss, noise or 1.0)
    steps, settled, values = 0, noise is not None, start.values
    if noise is None:
        problem = replace(problem, noise=problem.rms(values))
    for _ in range(MAX_NOISE_ROUNDS):
        end = descend(problem, values, rules, progress)
        values, steps, reason = end.state, steps + end.steps, end.reason
        if settled:
            break
        new = problem.estimate_noise(values)
        settled = abs(new / problem.noise - 1) < MAX_NOISE_CHANGE
        settled, problem = settled or not problem.noise_matters, replace(problem, noise=new)
        if settled:
            break
    return problem.finish(values, steps, reason if settled else "noise")  # pyright: ignore[reportPossiblyUnbound]


@dataclass(frozen=True, eq=False)
class _VectorProblem:
    """Residuals of a vector of parameters as a `LeastSquaresProblem`; its states are whole vectors (p,)."""

    residuals: Callable[[np.ndarray], np.ndarray]
    jacobian: Callable[[np.ndarray], np.ndarray] | None
    start: Parameters
    stderr: np.ndarray
    loss: str
    noise: float

    @cached_property
    def free(self) -> np.ndarray:
        return np.flatnonzero(self.start.free)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([p.lower for p in self.start]), np.array([p.upper for p in self.start])

    @cached_property
    def prior(self) -> np.ndarray:
        """Inverse standard deviations of the free parameters (f,), 0 where nothing is known."""
        known = np.array([p.prior_stderr or np.inf for p in self.start], float)
        return 1 / known[self.free]

    @property
    def noise_matters(self) -> bool:
        """Whether the minimum depends on the noise."""
        return self.loss != "none" or bool(np.any(self.prior))

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Return residuals (N, m) in units of the noise."""
        r = np.asarray(self.residuals(values), float) / (self.stderr * self.noise)
        return r.reshape(len(r), -1)

    def rms(self, values: np.ndarray) -> float:
        return max(float(np.sqrt(np.mean((self.whitened(values) * self.noise) ** 2))), 1e-300)

    def cost(self, values: np.ndarray) -> float:
        with np.errstate(all="ignore"):
            r = self.whitened(values)
            away = (values - self.start.values)[self.free] * self.prior
            distance = np.linalg.norm(r, axis=1)
            return float(np.sum(compute_loss(self.loss, distance, r.shape[1])) + away @ away)

    def gain(self, state: np.ndarray, trial: np.ndarray) -> float:
        """Return the fall of the cost relative to the cost; one of rounding counts as none."""
        before, after = self.cost(state), self.cost(trial)
        return (before - after) / max(before, 1e-300)

    def move(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        out = state.copy()
        out[self.free] += step
        return np.clip(out, *self.bounds)

    def linearise(self, state: np.ndarray) -> BoundedSystem:
        r, columns, _ = self._weighted(state)
        low, high = (bound[self.free] for bound in self.bounds)
        x = state[self.free]
        rows = np.vstack([columns, np.diag(self.prior)])
        target = np.concatenate([r, (self.start.values - state)[self.free] * self.prior])
        norm = np.linalg.norm(rows, axis=0)
        scales = 1 / np.where(norm > 0, norm, 1.0)
        return BoundedSystem(rows, target, scales, x <= low, x >= high, self.tolerance)

    @property
    def tolerance(self) -> float:
        return DIFFERENCED_RANK_TOLERANCE if self.jacobian is None else RANK_TOLERANCE

    def _weighted(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return weighted residuals (rows,), what a unit of each free parameter explains of them (rows, f), and weights (N,)."""
        r = self.whitened(state)
        w = compute_robust_weights(self.loss, np.linalg.norm(r, axis=1), r.shape[1])
        slope = self._differences(state) if self.jacobian is None else np.asarray(self.jacobian(state))[..., self.free]
        columns = -slope / (self.stderr * self.noise)[..., None]
        columns = columns.reshape(*r.shape, len(self.free)) * np.sqrt(w)[:, None, None]
        return (r * np.sqrt(w)[:, None]).ravel(), columns.reshape(r.size, -1), w

    def _differences(self, state: np.ndarray) -> np.ndarray:
        """Return the residuals' derivative by the free parameters, by central differences inside the bounds."""
        low, high = self.bounds
        out = []
        for k in self.free:
            h = np.finfo(float).eps ** (1 / 3) * max(abs(state[k]), abs(self.start.values[k]), 1e-3)
            above, below = state.copy(), state.copy()
            above[k], below[k] = min(state[k] + h, high[k]), max(state[k] - h, low[k])
            width = max(above[k] - below[k], 1e-300)
            out.append((np.asarray(self.residuals(above)) - np.asarray(self.residuals(below))) / width)
        return np.stack(out, axis=-1)

    def estimate_noise(self, values: np.ndarray) -> float:
        """Return the noise from the residuals and what the parameters leave of them, `n - trace(H)`."""
        system, r = self.linearise(values).free, self.whitened(values)
        w = compute_robust_weights(self.loss, np.linalg.norm(r, axis=1), r.shape[1])
        used, m = w > 0, r.shape[1]
        hat = system.leverage[: r.size].reshape(r.shape)
        n = float(used.sum()) * m
        left = max(n - float(hat[used].sum()), 1.0)
        if self.loss == "none":
            ratio = np.sqrt(np.sum(r**2) / left)
        else:
            ratio = estimate_distance_scale(np.linalg.norm(r[used], axis=1), m) * np.sqrt(n / left)
        return max(float(self.noise * ratio), 1e-300)

    def finish(self, values: np.ndarray, steps: int, reason: str) -> NonlinearEstimate:
        r, bounded = self.whitened(values), self.linearise(values)
        distance, m = np.linalg.norm(r, axis=1), r.shape[1]
        held, system = bounded.held(), bounded.free
        cov = np.zeros((len(self.free),) * 2)
        cov[np.ix_(~held, ~held)] = system.covariance * compute_loss_covariance_factor(self.loss, distance, m)
        told = np.zeros(len(self.free), bool)
        told[~held] = ~system.undetermined
        error = dict(zip(self.free, np.where(told, np.sqrt(np.diag(cov)), np.nan), strict=True))
        rows = (
            replace(p, value=float(v), stderr=float(error[k]) if np.isfinite(error.get(k, np.nan)) else None)
            for k, (p, v) in enumerate(zip(self.start, values, strict=True))
        )
        weights = compute_robust_weights(self.loss, distance, m)
        plain = r * self.noise * np.asarray(self.stderr).reshape(r.shape)
        return NonlinearEstimate(
            Parameters(rows), cov, plain, weights, self.noise, self.cost(values), system.rank, steps, reason
        )
