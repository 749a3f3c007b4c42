"""Estimates at the statistical limit: full-rate equations, the noise's exact weights, instruments instead of noisy columns.

**Equations** at a log's own rate, without the low-pass that the regression puts before decimation. Accelerations are second
differences of the raw positions, so that the noise of an equation is known exactly (`estimate/autoregression.py`); positions
and speeds, whose noise matters little, are low-passed. An equation is left out if a sign is not sure, if a force is saturated
or flagged, and near a reversal of any joint: a second difference does not represent the jump of the acceleration there.

**Estimate.** A first estimate (weighted least squares) gives the force noise in addition to the encoders' noise
(`estimate_encoder_noise`), and the equations are whitened with both. Then, two or three times,

    ml      Z along q_hat = q + sigma_q^2 D' Sigma^-1 (tau - Y theta), the most likely true motion given positions *and* forces.
            Its errors are uncorrelated with the equations' (cov(n, r) = -sigma_q^2 D' cancels): maximum likelihood with errors in
            all variables. Needs no reference. A controller that reacts to the encoders' noise correlates the two again.
    iv      Z along the motion that follows from the log's references, which contain neither noise, with or without feedback.
    robust  ml, with bisquare weights on each sample of force.

The limit is the Cramer-Rao bound `(Y' Sigma^-1 Y)^-1` at the true motion, with true positions as nuisance parameters.

**References.** The deviation of the robot from its reference is a response to the forces and to the reference itself:

    q - q_ref = sum_k h_k(t) * s_k(t),   s = forces, speeds and accelerations along the reference,

with impulse responses `h` of half a second, piecewise linear over lags that grow by half and fitted by least squares: some
hundred numbers from as many equations as there are samples, so that almost no encoder noise passes. The controller need not be
known. If it is known, simulating the closed loop does the same (Janot, Vandanjon & Gautier 2014); this only approximates
it, which costs precision but not consistency, since signals that follow from references alone are independent of the noise.

References: Soderstrom 2018; Janot, Vandanjon & Gautier 2014; Brunot, Janot, Young & Carrillo 2018.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.fft import next_fast_len

from tau_dyn.effects import get_measured_signals
from tau_dyn.estimate import (
    REACH,
    Estimate,
    InstrumentalSolution,
    PhysicalConstraints,
    PositionNoise,
    Preparation,
    WhiteRows,
    build_position_noise,
    compute_accelerations,
    compute_bisquare_weights,
    compute_robust_covariance_factor,
    estimate_of,
    estimate_robust_scale,
    solve_instrumental_variables,
)
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify.preparation import find_excluded_samples, find_unsure_samples, widen
from tau_dyn.log import Log, compute_edge_samples, differentiate, estimate_encoder_noise, lowpass
from tau_dyn.model import Model

MAX_RESPONSE_LAG_S = 0.5
"""Longest lag of the response to a reference [s]."""

FINE = 4
"""Lags up to this sample are one sample apart; beyond, they grow by half."""


def predict_tracked_motion(model: Model, log: Log, preparation: Preparation, q: np.ndarray) -> np.ndarray:
    """Return positions (n, m) that follow from the references alone.

    Args:
        model: Model that gives the forces along the reference.
        log: An even stretch with `q_ref_J` of every actuated joint.
        preparation: Filters, with the low-pass before the references are differentiated.
        q: Measured positions (n, m).
    """
    reference = log.joint("q_ref", model.robot.actuated)
    features = _responses(_sources(model, log, preparation, reference), log.dt)
    scale = np.linalg.norm(features, axis=0)
    features = features / np.where(scale > 0, scale, 1.0)
    gram, moment = features.T @ features, features.T @ (q - reference)
    ridge = 1e-10 * np.eye(len(gram))
    return reference + features @ linalg.solve(gram + ridge, moment, assume_a="pos")


def _sources(model: Model, log: Log, preparation: Preparation, reference: np.ndarray) -> np.ndarray:
    """Return the inputs of the deviation (n, 3 m): forces, speeds and accelerations along the reference."""
    q = lowpass(reference, preparation.position_cutoff_hz, log.rate_hz)
    v = differentiate(q, log.dt, accuracy=4)
    a = differentiate(v, log.dt, accuracy=4)
    force = model.steady().torque(q, v, a)
    return np.column_stack([force, v, a])


def _responses(sources: np.ndarray, dt: float) -> np.ndarray:
    """Return sources (n, k) behind each piece of the impulse responses (n, k lags), and a constant."""
    n, lags = len(sources), _lags(int(np.ceil(MAX_RESPONSE_LAG_S / dt)))
    length = next_fast_len(n + lags[-1] + 1, real=True)
    spectrum = np.fft.rfft(sources, length, axis=0)
    found = [np.ones((n, 1))]
    for before, at, after in zip(lags[:-2], lags[1:-1], lags[2:], strict=True):
        hat = np.interp(np.arange(after + 1), [before, at, after], [0.0, 1.0, 0.0], left=0.0)
        found.append(np.fft.irfft(spectrum * np.fft.rfft(hat, length)[:, None], length, axis=0)[:n])
    return np.concatenate(found, axis=1)


def _lags(last: int) -> list[int]:
    """Return the knots of the impulse responses, in samples, from one sample before zero."""
    lags = [-1, *range(FINE + 1)]
    while lags[-1] < last:
        lags.append(int(np.ceil(1.5 * lags[-1])))
    return lags


INERTIA_EVERY = 10
"""Samples between two mass matrices; those between are interpolated."""

SIGN_THRESHOLD_RATIO = 0.4
"""Share of the regression's speed threshold above which a sign is sure here: four times the velocity's noise."""


@dataclass(frozen=True, eq=False)
class FullRate:
    """One even stretch of a log.

    Attributes:
        log: The stretch.
        position: Raw positions (n, m) [m or rad].
        smooth: Positions and speeds behind the position low-pass, each (n, m).
        signals: Further signals that effects need.
        force: Logged forces (n, m) [N or N m].
        W: Columns with the accelerations of the raw positions (n, m, p).
        inertia: Mass matrices (n, m, m).
        keep: Which equations count (n, m).
    """

    log: Log
    position: np.ndarray
    smooth: tuple[np.ndarray, np.ndarray]
    signals: Mapping[str, np.ndarray]
    force: np.ndarray
    W: np.ndarray
    inertia: np.ndarray
    keep: np.ndarray

    def columns(self, model: Model, a: np.ndarray) -> np.ndarray:
        """Return the columns (n, m, p) with other accelerations (n, m)."""
        return _columns(model, self.log, *self.smooth, a, self.signals)


def build_full_rate_equations(model: Model, log: Log, preparation: Preparation) -> FullRate:
    """Return the equations of one even stretch.

    Args:
        model: Its values give the mass matrices.
        log: An even stretch without gaps.
        preparation: Gives the position low-pass, the speed thresholds and the columns that flag samples.
    """
    joints, rate = model.robot.actuated, log.rate_hz
    raw = log.joint("q", joints)
    q = lowpass(raw, preparation.position_cutoff_hz, rate)
    v = differentiate(q, log.dt, accuracy=4)
    signals = get_measured_signals(log, joints, q, v, preparation.speed_threshold)
    W = _columns(model, log, q, v, compute_accelerations(raw, log.dt), signals)
    shut = find_unsure_samples(v, SIGN_THRESHOLD_RATIO * preparation.speed_threshold)
    shut |= find_excluded_samples(log, joints, model.robot.effort_limit, preparation.exclude)
    keep = ~widen(shut, REACH)  # an acceleration reaches so far
    edge = compute_edge_samples(preparation.position_cutoff_hz, rate)
    keep[:edge] = keep[len(keep) - edge :] = False
    return FullRate(log, raw, (q, v), signals, log.joint("tau", joints), W, _inertia(model, q), keep)


def _columns(model: Model, log: Log, q: np.ndarray, v: np.ndarray, a: np.ndarray, signals: Mapping) -> np.ndarray:
    return model.columns(model.motion(q, v, a, np.sign(v), t=log.t, signals=signals))


def _inertia(model: Model, q: np.ndarray) -> np.ndarray:
    """Return mass matrices (n, m, m) along positions (n, m), interpolated between every tenth."""
    places = np.unique(np.append(np.arange(0, len(q), INERTIA_EVERY), len(q) - 1))
    found = model.mechanism.inertia(q[places])
    share = np.interp(np.arange(len(q)), places, np.arange(len(places)))
    low = np.minimum(share.astype(int), max(len(places) - 2, 0))
    part = (share - low)[:, None, None]
    return (1 - part) * found[low] + part * found[np.minimum(low + 1, len(places) - 1)]


MAX_ITERATIONS = 6  # of instruments and noise model
MAX_CHANGE_STDERRS = 0.02
"""Iterations end when no base parameter moves by more than this part of its standard error."""

NOISE_SAMPLES = 20_000
"""Samples of a stretch for estimating the force noise; it is a weight, and these determine it to 1 %."""

NOISE_ROUNDS = 12  # iterations of the noise model alone
MIN_ROBUST_WEIGHT = 1e-3
"""Smallest weight; a sample with it has 30 times the force noise."""


@dataclass(frozen=True, eq=False)
class FullRateEstimate:
    """An estimate, and its whitened residuals (n, m), which show whether the noise was as assumed."""

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
    """Return the estimate at full rate, starting from a first one.

    Args:
        model: The fitted model.
        pieces: Even stretches of the training logs.
        first: Weighted least squares on the same logs.
        kind: `ml`, `iv` or `robust`.
        gains: Factor of each joint's logged force and its relative deviation.
        physics: Bodies to keep physical.

    Raises:
        CannotAnswer: Too few equations are left, or the references do not determine the motion.
    """
    gains = gains or {}
    preparation = first.regression.preparation
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
    fit = _FullRateFit(at, first, stretches, any(sigma for _, sigma in gains.values()))
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


class _FullRateFit:
    """The iterations of one estimation."""

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
        """Return the solution with bisquare weights on each sample of force, and the factor on its covariance."""
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
        return build_position_noise(s.inertia[part], keep, s.log.dt, force, self.position)

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
        r"""Return each joint's force noise (m,) from residuals, given the known encoder noise.

        `sigma^2 <- sigma^2 (s' s) / trace(Sigma^-1)` over the joint's equations, `s = Sigma^-1 r`: the fixed point is the
        likelihood's maximum. The trace comes from one row of random signs (Hutchinson 1990).
        """
        start = np.sqrt(2 * self.first.regression.preparation.force_cutoff_hz * self.stretches[0].log.dt)
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
    """Return the largest change of a base parameter in its own standard errors, from the information matrix."""
    stderr = np.sqrt(np.abs(np.diag(np.linalg.inv(after.J))))
    return float(np.max(np.abs(after.beta - before.beta) / stderr))
