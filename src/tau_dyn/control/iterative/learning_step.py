"""The next correction of a repeated motion from its trials: commands and positions of one trial or several.

Case 1 of the thesis: the drives' positions are learnt. Gain, shift and cutoff that are not given are chosen for each drive
from the response estimated from the trials (`trial_response`, `joint_learning`). Every trial is compared with the prediction
from the earlier trials (`joint_learning`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.control.iterative.joint_learning import JointLearning, LawOptions, learn_joint
from tau_dyn.control.iterative.learned_outputs import Reference
from tau_dyn.control.iterative.resonant_drive import DriveModel
from tau_dyn.control.iterative.trial_loop import Convergence, FrequencyCondition, require_convergence
from tau_dyn.control.iterative.trial_response import POOR_MODEL
from tau_dyn.exceptions import InputError
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import Shown

_LEAD_SHARE = 0.1  # of the motion that learning takes to fade in, and out
_EDGES_HZ = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # of the bands that are listed
_SEEN = 2.0  # times the noise's power that a change has in a band, for its growth to be listed


@dataclass(frozen=True)
class LearningOptions:
    """Options of the learning law; values that are None are chosen.

    Attributes:
        gain: Part of the error that one iteration removes if the plant follows without delay.
        shift: Shift of the error forwards in time [samples].
        cutoff_hz: Highest frequency that is learnt [Hz].
        lead: Time in which learning fades in at the start and out at the end [s].
        monotone: Refuse a law that converges, but not in every single iteration.
    """

    gain: float | None = None
    shift: int | None = None
    cutoff_hz: float | None = None
    lead: float | None = None
    monotone: bool = True


@dataclass(frozen=True, eq=False)
class LearningStep(Shown):
    """The next correction and the state of the learning.

    Attributes:
        joints: Drives.
        dt: Sampling step [s].
        errors: Reference less position in each trial (K, N, m) [m or rad].
        previous: The last trial's correction (N, m).
        correction: The next correction (N, m).
        expected: Expected mean error of the next trial (N, m).
        full: Samples where learning acts fully.
        drives: Result of each drive.
    """

    joints: tuple[str, ...]
    dt: float
    errors: np.ndarray
    previous: np.ndarray
    correction: np.ndarray
    expected: np.ndarray
    full: slice
    drives: tuple[JointLearning, ...]

    @property
    def error(self) -> np.ndarray:
        """Error of the last trial (N, m)."""
        return self.errors[-1]

    @property
    def convergence(self) -> Convergence:
        """Convergence of all drives on their mean responses; a drive without a law neither converges nor grows."""
        parts = [drive.convergence for drive in self.drives]
        singular = tuple(1.0 if c is None else max(c.singular) for c in parts)
        radius = max(1.0 if c is None else c.radius for c in parts)
        return Convergence(
            singular, radius, _join([c.picture for c in parts if c is not None and c.picture is not None])
        )

    @property
    def gain(self) -> float | None:
        """Least gain of all drives; None without a law."""
        return min((d.law.gain for d in self.drives if d.law), default=None)

    @property
    def shift(self) -> int | None:
        """Largest shift of all drives [samples]; None without one."""
        return max((d.law.shift for d in self.drives if d.law and d.law.shift is not None), default=None)

    @property
    def cutoff_hz(self) -> float | None:
        """Least cutoff of all drives [Hz]; None without a law."""
        return min((d.law.cutoff_hz for d in self.drives if d.law), default=None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Drives whose learning changed or stopped, and actuators' models that the first trial contradicts."""
        out = []
        if len(self.errors) == 1 and np.any(self.previous):
            out.append(
                "no earlier trial is given, so this one is not compared with its prediction; --history takes them"
            )
        for joint, drive in zip(self.joints, self.drives, strict=True):
            if drive.action in ("change", "stop"):
                out.append(CodedWarning("prediction_missed", f"{joint}: {drive.reason}", (joint,)))
            elif drive.reason:
                out.append(f"{joint}: {drive.reason}")
            if drive.given_rms is not None and drive.given_rms > POOR_MODEL * drive.fitted_rms:
                said = (
                    f"{joint}: the model given misses the first trial by {drive.given_rms:.3g}; one fitted to that trial "
                    f"misses it by {drive.fitted_rms:.3g} and is used"
                )
                out.append(CodedWarning("model_contradicted", said, (joint,)))
        return tuple(out)

    def count_inside(self) -> tuple[int, int]:
        """Return how many outcomes are within their predicted intervals, and how many were predicted."""
        inside = [row["inside"] for row in self.to_trial_rows() if row["inside"] is not None]
        return sum(inside), len(inside)

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one row per drive: errors [m or rad], the law, and the next action."""
        previous, largest = (np.abs(x).max(axis=0) for x in (self.previous, self.correction))
        rows = []
        for k, (joint, drive) in enumerate(zip(self.joints, self.drives, strict=True)):
            law, growth = drive.law, drive.largest_growth
            rows.append({
                "joint": joint, "error_rms": float(drive.outcomes[-1]), "expected_error_rms": drive.forecast.rms,
                "expected_error_rms_ci95": [drive.forecast.low, drive.forecast.high],
                "largest_previous_correction": previous[k], "largest_correction": largest[k],
                "gain": law and law.gain, "shift_samples": law and law.shift, "inverts": bool(law and law.shift is None),
                "cutoff_hz": law and law.cutoff_hz,
                "largest_growth": growth[0], "largest_growth_ci95": list(growth[1:]), "floor_rms": law and law.floor,
                "from_trial": drive.base + 1, "action": drive.action, "reason": drive.reason,
            })  # fmt: skip
        return rows

    def to_trial_rows(self) -> list[dict[str, Any]]:
        """Return one row per trial and drive: its error, the predicted interval, and whether the error is inside."""
        rows = []
        for joint, drive in zip(self.joints, self.drives, strict=True):
            for k, (rms, forecast) in enumerate(zip(drive.outcomes, drive.forecasts, strict=True)):
                predicted = {"predicted_rms": None, "predicted_rms_ci95": None, "inside": None}
                if forecast is not None:
                    inside = bool(forecast.low <= rms <= forecast.high)
                    predicted = {
                        "predicted_rms": forecast.rms, "predicted_rms_ci95": [forecast.low, forecast.high], "inside": inside,
                    }  # fmt: skip
                rows.append({"trial": k + 1, "joint": joint, "error_rms": float(rms), **predicted})
        return rows

    def to_frequency_rows(self) -> list[dict[str, Any]]:
        """Return one row a band and drive: errors of the first and the last trial, growth in a trial predicted and achieved."""
        rows = []
        for k, (joint, drive) in enumerate(zip(self.joints, self.drives, strict=True)):
            f = drive.response.frequency
            powers = np.array([np.abs(drive.response.transform(e)) ** 2 for e in self.errors[:, :, k]])
            scale = 2 / (drive.response.length * drive.response.n)
            mean, stderr = drive.growth()
            for low, high in zip(_EDGES_HZ, _EDGES_HZ[1:], strict=False):
                inside = (f >= low) & (f < high)
                if not inside.any():
                    continue
                size = powers[:, inside].sum(axis=1)
                weight = powers[-1, inside] / max(size[-1], 1e-300)
                predicted, unsure = (float(np.sqrt(np.sum(weight * x[inside] ** 2))) for x in (mean, stderr))
                seen = len(size) > 1 and size[-2] > _SEEN * drive.response.noise[inside].sum()
                rows.append({
                    "joint": joint, "low_hz": low, "high_hz": high, "first_error_rms": float(np.sqrt(scale * size[0])),
                    "error_rms": float(np.sqrt(scale * size[-1])), "growth_predicted": predicted,
                    "growth_predicted_ci95": [max(predicted - 1.96 * unsure, 0.0), predicted + 1.96 * unsure],
                    "growth_achieved": float(np.sqrt(size[-1] / size[-2])) if seen else None,
                })  # fmt: skip
        return rows


def compute_learning_step(
    joints: Sequence[str],
    dt: float,
    reference: np.ndarray,
    commands: Sequence[np.ndarray],
    positions: Sequence[np.ndarray],
    actuators: Sequence[DriveModel] | None = None,
    options: LearningOptions = LearningOptions(),
) -> LearningStep:
    """Return the next correction of the drives' references.

    Args:
        joints: Names of the drives.
        dt: Sampling step [s].
        reference: The motion without any correction (N, m) [m or rad].
        commands: Command of each trial, reference plus correction, in the order of the trials; each (N, m).
        positions: Measured positions of each trial, on the same clock; each (N, m).
        actuators: A model of each drive; None takes them from the first trial. With a `ResonantDrive` the inverse of the
            response is tried as L.
        options: Options of the law.

    Raises:
        InputError: Shapes differ, the motion is too short, or the requested law would not converge.
        CannotAnswer: A drive never moves, or does not follow its command.
    """
    if not commands or len(commands) != len(positions):
        raise InputError("missing_input", "learning takes at least one trial, each with its command and its positions")
    wrong = next((x.shape for x in (*commands, *positions) if x.shape != reference.shape), None)
    if wrong is not None:
        raise InputError(
            "mismatch",
            f"reference, commands and trials have the same samples of {len(joints)} joints, not {reference.shape} and {wrong}",
        )
    n = len(reference)
    if dt > 0.4:
        raise InputError("invalid_value", f"a sample every {dt:g} s is too slow to learn from")
    lead = max(1, round((_LEAD_SHARE * n * dt if options.lead is None else options.lead) / dt))
    asked = LawOptions(options.gain, options.shift, options.cutoff_hz)
    drives = []
    for k in range(len(joints)):
        motion = Reference(dt, reference[:, [k]], np.zeros((n, 3)), first=lead, last=n - lead, lead=lead)
        given = None if actuators is None else actuators[k]
        drives.append(learn_joint(motion, [c[:, k] for c in commands], [y[:, k] for y in positions], given, asked))
    found = LearningStep(
        tuple(joints), dt, reference - np.asarray(positions), commands[-1] - reference,
        np.column_stack([d.correction for d in drives]), np.column_stack([d.forecast.error for d in drives]),
        slice(lead, n - lead), tuple(drives),
    )  # fmt: skip
    if asked.given:
        require_convergence(found.convergence, monotone=options.monotone)
    return found


def _join(pictures: Sequence[FrequencyCondition]) -> FrequencyCondition | None:
    """Return the frequency conditions of several drives as one."""
    if not pictures:
        return None
    left, bound = (np.column_stack([getattr(p, name) for p in pictures]) for name in ("left", "bound"))
    return FrequencyCondition(pictures[0].frequency, left, bound, np.max([p.growth for p in pictures], axis=0))
