"""Choice of the estimator: weighted least squares, or one at the statistical limit if the log supports it.

wls     on the prepared regression: low-pass, gate, decimation. Robust to effects that the model omits.
ml      full rate, errors in all variables; needs no reference (`full_rate.py`).
iv      the same with instruments from `q_ref_J`; also unbiased if the controller reacts to the encoders' noise.
robust  ml with bisquare weights against outliers in the forces.
auto    iv if the log has references, else ml; wls if that is not more precise, or if the whitened residual shows that model
error, not noise, dominates it: weights that are exact for the noise are then wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.estimate import BaseParameters, Estimate, Regression, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.data import BuiltData
from tau_dyn.identify.fitted_model import build_physical_constraints
from tau_dyn.identify.full_rate import FullRateEstimate, estimate_full_rate
from tau_dyn.identify.per_log import average_over_logs, split_bodies
from tau_dyn.log import Log, estimate_encoder_noise
from tau_dyn.model import Model

ESTIMATORS = ("auto", "wls", "ml", "iv", "robust")

MAX_COLUMN_VALUES = 30_000_000
"""Numbers in the full-rate columns (samples x joints x columns) up to which they are held in memory."""

PARAMETER_DEPENDENT_SIGNALS = frozenset(
    {"force", "rigid_force", "load", "reducer_torque", "inertia", "damping", "weight_gradient"}
)
"""Signals that follow from the parameters' values, so that a fit changes the columns it was made with."""

MAX_ITERATIONS = 8  # bounds the time of a fit that does not converge
RELATIVE_CHANGE_TOL = 0.01
"""A fit is repeated until the predicted force moves by less than this share of the residual."""

CLEAN_REFERENCE = 0.2
"""Largest noise of references, as a share of the encoders' noise; references with more are measurements themselves."""

MAX_IN_BAND_EXCESS_POWER = 0.25
"""Excess of the whitened residual's power in the motion's band above which the model, not noise, makes it."""

BANDS = (1.0, 0.4, 0.2)
"""Parts of the force low-pass' cutoff below which the power is tested; the last is about the motion's own band."""

CORRELATION = 0.05
"""Correlation of neighbouring whitened residuals above which the noise is not as assumed."""


@dataclass(frozen=True, eq=False)
class Estimator:
    """The choice of an estimator for a model and its logs.

    Attributes:
        kind: One of `ESTIMATORS`.
        model: The fitted model.
        pieces: Even stretches of the training logs, in the order of the regression's runs.
        gains: Factor of each joint's logged force and its relative deviation.
        structural: Base parameters that any motion could show.
    """

    kind: str
    model: Model
    pieces: Sequence[Log]
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    structural: BaseParameters | None = None

    def __post_init__(self) -> None:
        """Refuse an unknown name, and logs or models that the requested estimator cannot handle."""
        if self.kind not in ESTIMATORS:
            raise InputError("bad_option", f"estimator '{self.kind}' is not one of {', '.join(ESTIMATORS)}")
        if self.kind in ("ml", "iv", "robust"):
            fault = self._fault(self.kind)
            if fault:
                raise InputError("bad_option", f"--estimator {self.kind}: {fault}")

    @property
    def structural_rank(self) -> int:
        """Number of base parameters that any motion could show."""
        return 0 if self.structural is None else self.structural.rank

    def solve(self, built: BuiltData, part: Regression | None = None) -> Estimate:
        """Return the estimate by the chosen estimator, from data or a part of their regression; full rate reads the data."""
        sigmas = {joint: sigma for joint, (_, sigma) in self.gains.items()}
        regression = built.regression if part is None else part
        physics = split_bodies(build_physical_constraints(self.model), regression.parameters)
        first = solve_least_squares(regression, physics=physics, structural=self.structural, gains=sigmas)
        return replace(self, pieces=built.data.pieces)(first)

    def __call__(self, first: Estimate) -> Estimate:
        """Return the estimate by the chosen estimator, given weighted least squares on the pieces or their parts."""
        if self.kind == "auto":
            return self._automatic(first)
        if self.kind == "wls":
            return first
        found = self._refined(first, self.kind)
        doubtful = self.kind != "robust" and not is_residual_white(found)
        sentence = (
            f"the residual is not the noise that estimator {self.kind} takes it for; its errors are wider than they need be, "
            "and --estimator wls or diagnose may serve better"
        )
        return replace(found.estimate, estimator=self.kind, warnings=(sentence,) if doubtful else ())

    def _automatic(self, first: Estimate) -> Estimate:
        if len(self.pieces) != len(first.regression.runs):
            return first
        for kind in ("iv", "ml"):
            if self._fault(kind):
                continue
            try:
                found = self._refined(first, kind)
            except (CannotAnswer, np.linalg.LinAlgError):
                continue
            if not is_residual_white(found):
                break
            if np.mean(np.diag(found.estimate.cov) / np.diag(first.cov)) < 1:
                return replace(found.estimate, estimator=kind)
        return first

    def _refined(self, first: Estimate, kind: str) -> FullRateEstimate:
        pieces = [_part(log, run.t) for log, run in zip(self.pieces, first.regression.runs, strict=True)]
        return estimate_full_rate(
            self.model, pieces, first, kind, gains=self.gains, physics=build_physical_constraints(self.model)
        )

    def _fault(self, kind: str) -> str:
        """Return why an estimator cannot handle this model and these logs; empty if it can."""
        joints = self.model.robot.actuated
        if self.model.robot.base_coordinates:
            return "the forces of the ground are not known at full rate; use wls"
        odd = [
            e.name
            for e in self.model.effects
            if e.measured or {"campaign", *PARAMETER_DEPENDENT_SIGNALS} & set(e.needs)
        ]
        if odd:
            return f"effect {odd[0]} feels more than a motion at full rate gives; use wls"
        if not all(isinstance(log, Log) for log in self.pieces):
            return (
                "a recording on disk is read in blocks, and it needs all samples at once; use wls, or give an excerpt"
            )
        size = sum(log.n_samples for log in self.pieces) * len(joints) * len(self.model.parameters)
        if size > MAX_COLUMN_VALUES:
            return (
                f"the logs are too long for it ({size:.2g} numbers at full rate, {MAX_COLUMN_VALUES:.2g} fit); "
                f"use wls or fewer logs"
            )
        return _reference_fault(self.pieces, joints) if kind == "iv" else ""


def is_residual_white(found: FullRateEstimate) -> bool:
    """Return whether whitened residuals are white in the motion's band: no excess power, no autocorrelation."""
    cutoff = found.estimate.regression.preparation.force_cutoff_hz
    for k in range(found.residuals[0].shape[1]):
        pairs = [(e[:, k], s.keep[:, k], s.log.rate_hz) for e, s in zip(found.residuals, found.stretches, strict=True)]
        count = max(sum(int(keep.sum()) for _, keep, _ in pairs), 1)
        power = sum(float(np.sum(x**2)) for x, _, _ in pairs) / count
        neighbours = max(sum(int(np.sum(keep[1:] & keep[:-1])) for _, keep, _ in pairs), 1)
        memory = sum(float(np.sum(x[1:] * x[:-1])) for x, _, _ in pairs) / neighbours
        if abs(memory) > power * (CORRELATION + 4 / np.sqrt(count)):
            return False
        for part in BANDS:
            low, blocks = _power_below(part * cutoff, pairs)
            if low > power * (1 + MAX_IN_BAND_EXCESS_POWER + 4 * np.sqrt(2 / max(blocks, 1))):
                return False
    return True


def _power_below(edge_hz: float, pairs: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> tuple[float, int]:
    """Return the power of one output's residuals below a frequency, relative to white noise, and its number of blocks."""
    power, blocks = 0.0, 0
    for x, keep, rate in pairs:
        width = max(2, int(rate / (2 * edge_hz)))
        edges = np.arange(0, len(x), width)
        sums, counts = np.add.reduceat(x, edges), np.add.reduceat(keep.astype(float), edges)
        full = counts > 0.5 * width
        power += float(np.sum(sums[full] ** 2 / counts[full]))
        blocks += int(full.sum())
    return power / max(blocks, 1), blocks


def _reference_fault(pieces: Sequence[Log], joints: tuple[str, ...]) -> str:
    for log in pieces:
        if not log.has("q_ref", joints):
            return f"{log.name} has no q_ref of every joint, from which instruments are made; use ml, or log the references"
        reference = log.joint("q_ref", joints)
        noisy = (
            estimate_encoder_noise(reference) > CLEAN_REFERENCE * estimate_encoder_noise(log.joint("q", joints)) + 1e-12
        )
        if noisy.any():
            joint = joints[int(np.argmax(noisy))]
            return f"q_ref_{joint} of {log.name} is as noisy as an encoder, so it is no reference; use ml"
        if np.any(np.ptp(reference, axis=0) == 0):
            return f"a reference of {log.name} never moves; use ml"
    return ""


def _part(log: Log, t: np.ndarray) -> Log:
    """Return the stretch of a log that a run spans."""
    step = t[1] - t[0] if len(t) > 1 else 0.0
    return log.select_time(t[0], min(t[-1] + step, log.t[-1] + log.dt))


class Settled(NamedTuple):
    """A fit, its data, and its warnings."""

    built: BuiltData
    estimate: Estimate
    warnings: tuple[str, ...]


def iterate_to_fixed_point(built: BuiltData, solver: Estimator) -> Settled:
    """Return the fit, iterated if effects depend on forces or loads that follow from the fitted values.

    Friction in proportion to a load, or a gain of the model's own force, has columns that depend on the estimate: they are
    computed again with the signals of the last estimate. Each iteration reduces a gain error `g` by a factor `g`, and an error of
    load-dependent friction by its share of the force; two or three iterations are typical.

    Args:
        built: The data, with signals at the values to start from.
        solver: The estimator.
    """
    model, estimate = built.data.model, solver.solve(built)
    feeling = [effect.name for effect in model.effects if PARAMETER_DEPENDENT_SIGNALS & set(effect.needs)]
    if not feeling:
        return Settled(built, estimate, estimate.warnings)
    for _ in range(MAX_ITERATIONS):
        before, theta = built.regression, estimate.theta
        built = built.data.build(model.with_parameters(average_over_logs(estimate, model.parameters)))
        estimate = solver.solve(built)
        moved, left = _changed(before, theta, built.regression, estimate.theta)
        if moved <= RELATIVE_CHANGE_TOL * left:
            return Settled(built, estimate, estimate.warnings)
    sentence = (
        f"no convergence in {MAX_ITERATIONS} iterations: effect {feeling[0]} depends on a force or load that "
        f"changes with the estimate"
    )
    return Settled(built, estimate, (*estimate.warnings, sentence))


def _changed(before: Regression, theta: np.ndarray, after: Regression, now: np.ndarray) -> tuple[float, float]:
    """Return by how much the residual moved and how large it is now: roots of sums of squares over usable samples."""
    moved = left = 0.0
    for one, other in zip(before.rows(), after.rows(), strict=True):
        for x, y in zip(one, other, strict=True):
            e = y.y - y.W @ now
            moved += float(np.sum((e - (x.y - x.W @ theta))[y.usable] ** 2))
            left += float(np.sum(e[y.usable] ** 2))
    return moved**0.5, left**0.5
