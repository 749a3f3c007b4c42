"""The result of identification through a closed loop, and its JSON form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.estimate import MAX_RELATIVE_STDERR
from tau_dyn.evidence import PoorFit
from tau_dyn.log import Log
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.results import Z95, Shown
from tau_dyn.servo.contact import Contact
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import ServoLaw


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Errors of simulated positions on some logs.

    Attributes:
        joints: Actuated joints.
        logs: Names of the logs.
        rms: Residual rms over the samples that are used, log by log (S, na) [rad]; NaN without such samples.
        count: Number of samples used (S,).
        size: rms of the measured positions about their mean (S, na) [rad].
        command_rms: rms of measured minus commanded position (S, na) [rad]: the error of a simulation without a model.
        used_share: Share of the samples that are used.
        all_samples: The same over all samples; None in that object itself.
    """

    joints: tuple[str, ...]
    logs: tuple[str, ...]
    rms: np.ndarray
    count: np.ndarray
    size: np.ndarray
    command_rms: np.ndarray
    used_share: float
    all_samples: PositionErrors | None

    def pool(self, values: np.ndarray) -> np.ndarray:
        """Return the rms (na,) over all logs of rms values log by log (S, na)."""
        return np.sqrt(np.nansum(values**2 * self.count[:, None], axis=0) / max(self.count.sum(), 1))

    @property
    def rms_per_joint(self) -> np.ndarray:
        """Residual rms of each joint (na,) [rad]."""
        return self.pool(self.rms)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form; errors are positions [rad or m]."""
        rms, size, command = self.rms_per_joint, self.pool(self.size), self.pool(self.command_rms)
        rows = {
            joint: {"rms": float(r), "relative_error_percent": _percent(r, s), "command_rms": float(c)}
            for joint, r, s, c in zip(self.joints, rms, size, command, strict=True)
        }
        per_log = {
            log: {joint: float(x) for joint, x in zip(self.joints, row, strict=True)}
            for log, row in zip(self.logs, self.rms, strict=True)
        }
        out: dict[str, Any] = {
            "relative_error_percent": _percent(float(np.linalg.norm(rms)), float(np.linalg.norm(size))),
            "per_joint": rows,
            "per_log": per_log,
        }
        if self.all_samples is not None:
            out |= {"used_share": self.used_share, "all_samples": self.all_samples.to_dict()}
        return out


def build_position_errors(
    joints: tuple[str, ...], records: Sequence[LoopRecord], predicted: Sequence[np.ndarray]
) -> PositionErrors:
    """Return the errors of predicted positions (N, na), record by record."""
    whole = _build_errors(joints, records, predicted, [np.ones(len(r.t), bool) for r in records], None)
    return _build_errors(joints, records, predicted, [r.used for r in records], whole)


def _build_errors(joints, records, predicted, masks, whole) -> PositionErrors:  # noqa: ANN001
    pairs = list(zip(records, predicted, masks, strict=True))
    total = sum(len(r.t) for r in records)
    return PositionErrors(
        joints,
        tuple(r.name for r in records),
        np.array([_rms((r.measured - p)[m]) for r, p, m in pairs]),
        np.array([int(m.sum()) for m in masks]),
        np.array([_rms((r.q - r.q[m].mean(axis=0) if m.any() else r.q)[m]) for r, _, m in pairs]),
        np.array([_rms((r.q - r.goal)[m]) for r, _, m in pairs]),
        float(sum(m.sum() for m in masks) / max(total, 1)),
        whole,
    )


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0)) if len(x) else np.full(x.shape[1], np.nan)


def _percent(part: float, whole: float) -> float:
    return float(100 * part / whole) if whole > 0 else 0.0


@dataclass(frozen=True, eq=False)
class LoopParameter:
    """One identified parameter.

    Attributes:
        name: Contract name.
        value: Its value [unit].
        unit: Its unit.
        stderr: Standard error; None if the logs do not determine it by itself.
        nominal: Value of the robot file or the law file; None if there is no trusted value.
        nominal_stderr: Standard error of the nominal value.
        lower: Lower bound.
        upper: Upper bound.
        identifiable: Whether any motion could determine it by itself.
        expression: The combination that it denotes; empty for the parameter itself.
    """

    name: str
    value: float
    unit: str
    stderr: float | None
    nominal: float | None
    nominal_stderr: float | None
    lower: float = -np.inf
    upper: float = np.inf
    identifiable: bool = True
    expression: str = ""

    @property
    def at_bound(self) -> bool:
        """Whether it is at a bound."""
        return bool(self.value <= self.lower or self.value >= self.upper)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        row: dict[str, Any] = {"name": self.name, "value": self.value, "unit": self.unit, "stderr": self.stderr}
        known = self.stderr is not None and not self.at_bound
        if self.expression:
            row["expression"] = self.expression
        wide = Z95 * (self.stderr or 0.0)
        interval = [max(self.lower, self.value - wide), min(self.upper, self.value + wide)] if known else None
        return row | {
            "ci95": interval,
            "identifiable": self.identifiable,
            "determined": bool(
                known and self.stderr is not None and self.stderr < MAX_RELATIVE_STDERR * abs(self.value)
            ),
            "nominal": self.nominal,
            "nominal_stderr": self.nominal_stderr,
            "at_bound": self.at_bound,
        }


@dataclass(frozen=True, eq=False)
class LoopIdentification(Shown):
    """Parameters identified through the closed loop, and their quality.

    Attributes:
        model: The model at its identified values, with the servo's law; save it, simulate it.
        law: The servo's law at its identified values.
        parameters: Joint by joint, then the bodies'.
        base_parameters: The identifiable combinations of the bodies' parameters.
        train: Errors on the training logs, simulated from their commands alone.
        holdout: Errors on held-out data; None without such data.
        holdout_how: How the held-out errors were obtained, in words.
        contacts: Contacts of the tool with an object.
        warnings: Warnings, one sentence each.
        seed: Seed of all random steps.
        logs: The training logs.
        shown: Records and predicted positions for display, held-out ones first, each with whether it is held out.
        friction: Name of the friction model.
        n_samples: Samples that the fit used.
        condition_number: Condition number of the normalised sensitivities.
        rank: Number of unknowns that were estimated.
        start: The fit's unknowns and their covariance, for a later fit.
        by_gain: Estimates of the drive from the logs of each gain alone, row by row, if logs have different gains.
        poor_fits: Joints whose simulation differs from the training logs by far more than the encoder's noise.
    """

    model: Model
    law: ServoLaw
    parameters: tuple[LoopParameter, ...]
    base_parameters: tuple[LoopParameter, ...]
    train: PositionErrors
    holdout: PositionErrors | None
    holdout_how: str
    contacts: tuple[Contact, ...]
    warnings: tuple[str, ...]
    seed: int
    logs: tuple[Log, ...]
    shown: tuple[tuple[LoopRecord, np.ndarray, bool], ...]
    friction: str
    n_samples: int
    condition_number: float
    rank: int
    start: Any = None
    by_gain: tuple[Mapping[str, Any], ...] = ()
    poor_fits: tuple[PoorFit, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """Return the parameter table in the contract's form."""
        return [p.to_dict() for p in self.parameters]

    def base_rows(self) -> list[dict[str, Any]]:
        """Return the base parameters with their expressions."""
        return [p.to_dict() for p in self.base_parameters]

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result, without the fields that the command adds (version, inputs, status)."""
        return {
            "seed": self.seed,
            **format_warnings(self.warnings),
            "measured": "position",
            "model": self.friction,
            "estimator": "output_error",
            "controller": self.law.to_dict(),
            "parameters": self.rows(),
            "base_parameters": self.base_rows(),
            "train": self.train.to_dict(),
            "holdout": None if self.holdout is None else self.holdout.to_dict(),
            "holdout_how": self.holdout_how,
            "contacts": [
                {
                    "log": c.log,
                    "joint": c.joint,
                    "start_s": c.start,
                    "stop_s": c.stop,
                    "share": c.share,
                    "height_m": c.height,
                }
                for c in self.contacts
            ],
            "by_gain": [dict(row) for row in self.by_gain],
            "condition_number": self.condition_number,
            "rank": self.rank,
            "n_samples": self.n_samples,
        }
