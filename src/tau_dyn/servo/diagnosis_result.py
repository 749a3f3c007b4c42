"""What a diagnosis through the closed loop answers, and its JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.results import Z95, Shown
from tau_dyn.servo.residual_structure import LoopStructure


@dataclass(frozen=True, eq=False)
class LoopFinding:
    """One cause at one joint.

    Attributes:
        cause: Its name.
        joint: The joint.
        status: `confirmed` or `suspected`.
        score: Its number in standard errors.
        p_value: Of the confirmation.
        value: Its number [unit].
        stderr: Its standard error.
        unit: Its unit.
        before: rms of the joint's held-out residual without it [rad].
        after: With it [rad].
        interval: 95 % interval of the reduction [%].
        twins: Causes that explain the same here.
    """

    cause: str
    joint: str
    status: str
    score: float
    p_value: float
    value: float
    stderr: float
    unit: str
    before: float
    after: float
    interval: tuple[float, float]
    twins: tuple[str, ...]

    @property
    def reduction(self) -> float:
        """Fall of the held-out rms [%]."""
        return 100 * (1 - self.after / self.before) if self.before > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        row = {"name": f"{self.joint}.{LOOP_CAUSES[self.cause].entries[0]}", "value": self.value, "unit": self.unit}
        wide = Z95 * self.stderr
        return {
            "cause": self.cause, "joints": [self.joint], "status": self.status, "score": self.score, "p_value": self.p_value,
            "parameters": [row | {"stderr": self.stderr, "ci95": [self.value - wide, self.value + wide]}],
            "gain": {"rms_before": self.before, "rms_after": self.after, "reduction_percent": self.reduction,
                     "ci95": list(self.interval)},
            "indistinguishable_from": list(self.twins), "equation": LOOP_CAUSES[self.cause].equation,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class LoopLimit:
    """The number that a cause must have to be found with 95 % power; joints at which these logs never show it are left out."""

    cause: str
    unit: str
    amplitudes: Mapping[str, float]

    @property
    def amplitude(self) -> float:
        """That of the joint where it is hardest to see."""
        return max(self.amplitudes.values())

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        joint = max(self.amplitudes, key=lambda j: self.amplitudes[j])
        phrase = f"{self.cause.replace('_', ' ')} of {self.amplitude:.2g} {self.unit} at {joint}"
        return {"amplitude": self.amplitude, "unit": self.unit, "phrase": phrase, "per_joint": dict(self.amplitudes)}


@dataclass(frozen=True, eq=False)
class LoopDiagnosis(Shown):
    """What the simulated loops miss, and why.

    Attributes:
        verdict: `named`, `nothing_found`, `unexplained` or `cannot_tell`.
        findings: Causes, strongest first.
        joints: Actuated joints.
        nominal: Held-out rms of the robot file's values in the law as given, without any fit (na,) [rad].
        baseline: Held-out rms of the baseline (na,) [rad].
        extended: Held-out rms of the extended model (na,) [rad].
        noise_floor: rms of the encoders' noise and rounding (na,) [rad].
        interval: 95 % interval of the fall of the held-out rms of all joints [%].
        recommendation: Which model to use: `extended`, `refitted`, or `neither`.
        recommendation_why: The reason.
        unexplained: Structure in the extended model's held-out residuals.
        limits: What would have been found of the causes that were not.
        untestable: Causes that these logs cannot tell: cause, why, experiment.
        extended_model: The model with its law.
        warnings: What is doubtful.
        seed: Seed of the bootstrap.
    """

    verdict: str
    findings: tuple[LoopFinding, ...]
    joints: tuple[str, ...]
    nominal: np.ndarray
    baseline: np.ndarray
    extended: np.ndarray
    noise_floor: np.ndarray
    interval: tuple[float, float]
    recommendation: str
    recommendation_why: str
    unexplained: tuple[LoopStructure, ...]
    limits: tuple[LoopLimit, ...]
    untestable: tuple[dict[str, str], ...]
    extended_model: Model
    warnings: tuple[str, ...]
    seed: int

    @property
    def exit_status(self) -> int:
        """3 where the data cannot tell, else 0."""
        return CannotAnswer.exit_status if self.verdict == "cannot_tell" else 0

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result."""

        def rows(rms: np.ndarray) -> dict[str, Any]:
            return {"rms_per_joint": dict(zip(self.joints, map(float, rms), strict=True))}

        return {
            "status": "cannot_answer" if self.verdict == "cannot_tell" else "ok",
            "seed": self.seed, **format_warnings(self.warnings), "measured": "position", "verdict": self.verdict,
            "baseline": rows(self.baseline), "extended": rows(self.extended), "noise_floor": rows(self.noise_floor),
            "waterfall": [{"step": step, **rows(rms), "ci95": None} for step, rms in self.list_steps()],
            "findings": [f.to_dict() for f in self.findings], "untestable": list(self.untestable),
            "gain_percent_ci95": list(self.interval), "recommendation": self.recommendation,
            "recommendation_why": self.recommendation_why, "unexplained": [u.to_dict() for u in self.unexplained],
            "detection_limits": {limit.cause: limit.to_dict() for limit in self.limits},
            "controller": dict(self.extended_model.controller),
        }  # fmt: skip

    def list_steps(self) -> list[tuple[str, np.ndarray]]:
        """Return the steps from the robot file's values to the encoders' floor, with the held-out rms (na,) of each [rad]."""
        names = ("nominal", "refitted", "extended", "noise_floor")
        return list(zip(names, (self.nominal, self.baseline, self.extended, self.noise_floor), strict=True))
