"""Which estimator answers: weighted least squares, or one of those at the statistical limit where the log bears it.

wls     on the prepared regression: low-pass, gate, decimation. Stable where the model leaves something out.
ml      full rate, errors in all variables; needs no reference (`full_rate_estimators.py`).
iv      the same with instruments from `q_ref_J`; also unbiased where the controller answers the encoders' noise.
robust  ml with bisquare weights against outliers in the forces.
auto    iv where the log has references, else ml; wls where that is not more precise, or where the whitened residual
shows that the model, not noise, makes it: then exact weights are exactly wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tau_dyn.estimate import Estimate, Regression
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.fixed_point import PARAMETER_DEPENDENT_SIGNALS
from tau_dyn.identify.full_rate_estimators import FullRateEstimate, estimate_full_rate
from tau_dyn.identify.structural_identifiability import build_physical_constraints
from tau_dyn.log import Log, estimate_encoder_noise
from tau_dyn.model import Model

ESTIMATORS = ("auto", "wls", "ml", "iv", "robust")

MAX_COLUMN_VALUES = 30_000_000
"""Numbers in the full-rate columns (samples x joints x columns) up to which they are held in memory."""

CLEAN_REFERENCE = 0.2
"""Share of the encoders' noise that references may have; more, and they are measurements themselves."""

MAX_IN_BAND_EXCESS_POWER = 0.25
"""Excess of the whitened residual's power in the motion's band above which the model, not noise, makes it."""

BANDS = (1.0, 0.4, 0.2)
"""Parts of the force low-pass' cutoff below which the power is looked at; the last is about the motion's own band."""

CORRELATION = 0.05
"""Correlation of neighbouring whitened residuals above which the noise is not as assumed."""


@dataclass(frozen=True, eq=False)
class Estimator:
    """The choice of an estimator for a model and its logs.

    Attributes:
        kind: One of `ESTIMATORS`.
        model: What is fitted.
        pieces: Even stretches of the training logs, in the order of the regression's runs.
        gains: Factor of each joint's logged force and its relative deviation.
        warnings: Told what is doubtful.
    """

    kind: str
    model: Model
    pieces: Sequence[Log]
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Refuse an unknown name, and logs or models that the one asked for cannot take."""
        if self.kind not in ESTIMATORS:
            raise InputError("bad_option", f"estimator '{self.kind}' is none of {', '.join(ESTIMATORS)}")
        if self.kind in ("ml", "iv", "robust"):
            fault = self._fault(self.kind)
            if fault:
                raise InputError("bad_option", f"--estimator {self.kind}: {fault}")

    def __call__(self, first: Estimate) -> Estimate:
        """Return the estimate that answers, given weighted least squares on a regression of the pieces or of parts of them."""
        if self.kind == "auto":
            return self._automatic(first)
        if self.kind == "wls":
            return first
        found = self._refined(first, self.kind)
        if self.kind != "robust" and not is_residual_white(found):
            self.warnings.append(
                f"the residual is not the noise that estimator {self.kind} takes it for; its errors are wider than they need be, "
                "and --estimator wls or diagnose may serve better"
            )
        return _named(found.estimate, self.kind)

    def _automatic(self, first: Estimate) -> Estimate:
        if len(self.pieces) != len(first.regression.runs):
            return _named(first, "wls")
        for kind in ("iv", "ml"):
            if self._fault(kind):
                continue
            try:
                found = self._refined(first, kind)
            except (CannotAnswer, np.linalg.LinAlgError):
                continue
            if not is_residual_white(found):
                break
            if _size(found.estimate.cov, first.cov) < 1:
                return _named(found.estimate, kind)
        return _named(first, "wls")

    def _refined(self, first: Estimate, kind: str) -> FullRateEstimate:
        pieces = [_part(log, run.t) for log, run in zip(self.pieces, first.regression.runs, strict=True)]
        return estimate_full_rate(
            self.model, pieces, first, kind, gains=self.gains, physics=build_physical_constraints(self.model)
        )

    def _fault(self, kind: str) -> str:
        """Return why an estimator cannot take this model and these logs; empty where it can."""
        joints = self.model.robot.actuated
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
    """Return whether whitened residuals are white where the motion is: no more power in its band, no memory."""
    cutoff = found.estimate.regression.settings["preparation"].force_cutoff_hz
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
    """Return the power of one output's residuals below a frequency, in units of a white one's, and of how many blocks it is."""
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


def _size(cov: np.ndarray, other: np.ndarray) -> float:
    """Return the mean ratio of two covariances' diagonals."""
    return float(np.mean(np.diag(cov) / np.diag(other)))


def _named(estimate: Estimate, kind: str) -> Estimate:
    regression: Regression = estimate.regression
    return replace(estimate, regression=replace(regression, settings={**regression.settings, "estimator": kind}))
