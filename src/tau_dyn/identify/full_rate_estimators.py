r"""Estimates at the statistical limit: full-rate equations, the noise's exact weights, instruments instead of noisy columns.

From a first estimate (weighted least squares), the force noise is found beside the encoders' (`estimate_encoder_noise`), and the
equations are whitened by both. Then, two or three times over,

    ml      Z along q_hat = q + sigma_q^2 D' Sigma^-1 (tau - Y theta), the most likely true motion given positions *and* forces.
            Its errors are uncorrelated with the equations' (cov(n, r) = -sigma_q^2 D' cancels): maximum likelihood with errors in
            all variables. Needs no reference. A controller that answers the encoders' noise correlates the two again.
    iv      Z along the motion that follows from the log's references (`reference_instruments.py`), which no noise of either
    kind has
            touched, feedback or not.
    robust  ml, with bisquare weights on each sample of force.

The limit is the Cramer-Rao bound `(Y' Sigma^-1 Y)^-1` at the true motion, with true positions as nuisance parameters.
References: Soderstrom 2018; Janot, Vandanjon & Gautier 2014; Brunot, Janot, Young & Carrillo 2018.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.estimate import (
    Estimate,
    InstrumentalSolution,
    PhysicalConstraints,
    PositionNoise,
    WhiteRows,
    compute_accelerations,
    compute_bisquare_weights,
    compute_robust_covariance_factor,
    estimate_of,
    estimate_robust_scale,
    solve_instrumental_variables,
)
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify.full_rate import FullRate, build_full_rate_equations
from tau_dyn.identify.reference_instruments import predict_tracked_motion
from tau_dyn.log import Log, differentiate, estimate_encoder_noise
from tau_dyn.model import Model

MAX_ITERATIONS = 6  # of instruments and noise model
MAX_CHANGE_STDERRS = 0.02
"""Rounds end when no base parameter moves by more than this part of its standard error."""

NOISE_SAMPLES = 20_000
"""Samples of a stretch from which the force noise is found; it is a weight, and known to 1 % from these."""

NOISE_ROUNDS = 12  # iterations of the noise model alone
MIN_ROBUST_WEIGHT = 1e-3
"""Smallest weight; a sample with it has 30 times the force noise."""


@dataclass(frozen=True, eq=False)
class FullRateEstimate:
    """An estimate, and the whitened residuals (n, m) by which to tell whether the noise was as assumed."""

    estimate: Estimate
    residuals: tuple[np.ndarray, ...]
    rows: tuple[WhiteRows, ...]
    stretches: tuple[FullRate, ...]


def estimate_full_rate(
    model: Model,
    pieces: Sequence[Log],
    first: Estimate,
    kind: str,
    *,
    gains: Mapping[str, tuple[float, float]] | None = None,
    physics: PhysicalConstraints | None = None,
) -> FullRateEstimate:
    """Estimate again, at full rate.

    Args:
        model: What is fitted.
        pieces: Even stretches of the training logs.
        first: Weighted least squares on the same logs.
        kind: `ml`, `iv` or `robust`.
        gains: Factor of each joint's logged force and its relative deviation.
        physics: Bodies to keep physical.

    Raises:
        CannotAnswer: Too little is left, or the references tell nothing.
    """
    gains = gains or {}
    preparation = first.regression.settings["preparation"]
    at = model.with_parameters(first.parameters)
    factors = np.array([gains.get(j, (1.0, 0.0))[0] for j in model.robot.actuated])
    stretches = tuple(
        replace(s, force=s.force * factors)
        for s in (build_full_rate_equations(at, piece, preparation) for piece in pieces)
    )
    if sum(int(s.keep.sum()) for s in stretches) <= 10 * first.base.rank:
        raise CannotAnswer(
            "too_little_data", "too few samples are left where every sign is sure", "record a longer motion"
        )
    fit = _Fit(at, first, stretches, any(sigma for _, sigma in gains.values()))
    references = tuple(_reference_columns(at, s, preparation) for s in stretches) if kind == "iv" else None
    solution, rows, factor = fit.robust() if kind == "robust" else fit.settled(references)
    sigmas = {joint: sigma for joint, (_, sigma) in gains.items()}
    estimate = estimate_of(first, rows, solution, physics=physics, gains=sigmas, factor=factor)
    return FullRateEstimate(estimate, solution.residuals, rows, stretches)


def _reference_columns(model: Model, stretch: FullRate, preparation) -> np.ndarray:
    """Return the columns (n, m, p) along the motion that follows from the references."""
    log = stretch.log
    q = predict_tracked_motion(model, log, preparation, stretch.position)
    v = differentiate(q, log.dt, accuracy=4)
    a = compute_accelerations(q, log.dt)
    return model.columns(model.motion(q, v, a, np.sign(v), t=log.t, signals=stretch.signals))


class _Fit:
    """The rounds of one estimation."""

    def __init__(self, model: Model, first: Estimate, stretches: tuple[FullRate, ...], gains: bool) -> None:
        self.model, self.first, self.stretches, self.gains = model, first, stretches, gains
        parameters = first.regression.parameters
        self.free = np.flatnonzero(parameters.free)
        self.kept = self.free[first.base.kept]
        self.fixed = np.where(parameters.free, 0.0, parameters.values)
        self.position = np.sqrt(np.mean([estimate_encoder_noise(s.position) ** 2 for s in stretches], axis=0))
        self.force = self._force_noise(self._residuals(first.beta_plain))

    def settled(
        self, references: tuple[np.ndarray, ...] | None
    ) -> tuple[InstrumentalSolution, tuple[WhiteRows, ...], float]:
        """Return the solution with instruments along references, or along the most likely motion."""
        noises = [self._noise(s, self.force) for s in self.stretches]
        solution, rows = self._rounds(noises, references, self.first.beta_plain)
        return solution, rows, 1.0

    def robust(self) -> tuple[InstrumentalSolution, tuple[WhiteRows, ...], float]:
        """Return the solution with bisquare weights on each sample of force, and how much less certain they leave it."""
        plain = [self._noise(s, self.force) for s in self.stretches]
        beta, noises, scaled = self.first.beta_plain, plain, np.zeros(1)
        solution, rows = self._rounds(plain, None, beta)
        for _ in range(MAX_ITERATIONS):
            before = solution
            scaled, weights = self._weights(plain, self._residuals(solution.beta))
            noises = [self._noise(s, self.force / np.sqrt(w)) for s, w in zip(self.stretches, weights, strict=True)]
            solution, rows = self._rounds(noises, None, solution.beta)
            if _moved(before, solution) < MAX_CHANGE_STDERRS:
                break
        return solution, rows, compute_robust_covariance_factor(scaled)

    def _rounds(
        self, noises: list[PositionNoise], references: tuple[np.ndarray, ...] | None, beta: np.ndarray
    ) -> tuple[InstrumentalSolution, tuple[WhiteRows, ...]]:
        sides = [self._sides(s, noise) for s, noise in zip(self.stretches, noises, strict=True)]
        solution = None
        for _ in range(MAX_ITERATIONS):
            rows = []
            along = references or self._likely(noises, beta)
            for s, noise, Z, (W, y, shares) in zip(self.stretches, noises, along, sides, strict=True):
                rows.append(WhiteRows(s.log.t, noise.whiten(Z[:, :, self.kept]), W, y, shares, s.keep))
            before, solution = solution, solve_instrumental_variables(self.first, rows)
            beta = solution.beta
            if references is not None or (before is not None and _moved(before, solution) < MAX_CHANGE_STDERRS):
                break
        assert solution is not None
        return solution, tuple(rows)

    def _likely(self, noises: list[PositionNoise], beta: np.ndarray) -> list[np.ndarray]:
        """Return the columns along the most likely motion."""
        found = []
        for s, noise, r in zip(self.stretches, noises, self._residuals(beta), strict=True):
            q = s.position + self.position**2 * noise.to_positions(noise.solve(r))
            found.append(s.columns(self.model, compute_accelerations(q, s.log.dt)))
        return found

    def _sides(self, s: FullRate, noise: PositionNoise) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        y = s.force - s.W @ self.fixed
        shares = None
        if self.gains:
            shares = np.stack([noise.whiten(y * (np.arange(y.shape[1]) == k)) for k in range(y.shape[1])])
        return noise.whiten(s.W[:, :, self.kept]), noise.whiten(y), shares

    def _residuals(self, beta: np.ndarray) -> list[np.ndarray]:
        theta = self.fixed.copy()
        theta[self.kept] = beta
        return [s.keep * (s.force - s.W @ theta) for s in self.stretches]

    def _noise(self, s: FullRate, force: np.ndarray, part: slice = slice(None)) -> PositionNoise:
        keep = s.keep[part].copy()
        keep[:2] = keep[-2:] = False
        return PositionNoise(s.inertia[part], keep, s.log.dt, force, self.position)

    def _weights(self, noises: list[PositionNoise], residuals: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return scaled force residuals that count (N,) and weights (n, m) of each stretch."""
        found = [self.force**2 * noise.solve(r) for noise, r in zip(noises, residuals, strict=True)]
        keep = np.concatenate([s.keep for s in self.stretches])
        scale = estimate_robust_scale(np.concatenate(found), keep)
        scaled = [e / scale for e in found]
        return np.concatenate(scaled)[keep], [
            np.maximum(compute_bisquare_weights(x), MIN_ROBUST_WEIGHT) for x in scaled
        ]

    def _force_noise(self, residuals: list[np.ndarray]) -> np.ndarray:
        r"""Return each joint's force noise (m,) from residuals, beside the encoders' known one.

        `sigma^2 <- sigma^2 (s' s) / trace(Sigma^-1)` over the joint's equations, `s = Sigma^-1 r`: the fixed point is the
        likelihood's maximum. The trace comes from one row of random signs (Hutchinson 1990).
        """
        start = np.sqrt(2 * self.first.regression.settings["preparation"].force_cutoff_hz * self.stretches[0].log.dt)
        force = self.first.sigma / max(float(start), 1e-3)
        parts = [slice(max(0, (len(r) - NOISE_SAMPLES) // 2), (len(r) + NOISE_SAMPLES) // 2) for r in residuals]
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (NOISE_SAMPLES + 1, len(force)))
        for _ in range(NOISE_ROUNDS):
            seen, trace = np.zeros(len(force)), np.zeros(len(force))
            for s, r, part in zip(self.stretches, residuals, parts, strict=True):
                noise = self._noise(s, force, part)
                x = noise.keep * signs[: len(noise.keep)]
                both = noise.solve(np.stack([r[part], x], axis=2))
                seen += np.sum(both[:, :, 0] ** 2, axis=0)
                trace += np.sum(x * both[:, :, 1], axis=0)
            step = np.where(trace > 0, np.sqrt(seen / np.where(trace > 0, trace, 1.0)), 1.0)
            force = force * step
            if np.all(np.abs(step - 1) < 0.005):
                break
        return force


def _moved(before: InstrumentalSolution, after: InstrumentalSolution) -> float:
    """Return the largest move of a base parameter in its own standard errors, as the information has them."""
    stderr = np.sqrt(np.abs(np.diag(np.linalg.inv(after.J))))
    return float(np.max(np.abs(after.beta - before.beta) / stderr))
