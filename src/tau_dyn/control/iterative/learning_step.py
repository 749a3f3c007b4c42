"""One step of learning from files: a reference, one trial on it, the correction that was in force -> the next correction.

Case 1 of the thesis: the drives' positions are learnt, with fitted actuators as the model. What is not asked for is chosen: the
shift is what makes up best for delay and lag, the cutoff is the highest of a list at which every iteration comes closer, (7.16).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.control.iterative.convergence_analysis import (
    Convergence,
    analyse_convergence,
    compute_frequency_condition,
    require_convergence,
)
from tau_dyn.control.iterative.filters import TimeShift, design_low_pass
from tau_dyn.control.iterative.laws import LearningLaw
from tau_dyn.control.iterative.learned_outputs import MotorSide, Reference
from tau_dyn.control.iterative.lifted_system import stack_controlled_actuators
from tau_dyn.exceptions import InputError
from tau_dyn.modes import Actuator
from tau_dyn.results import Shown

_CUTOFFS_HZ = (40.0, 30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0)  # tried in turn; the thesis learns up to 10
_LEAD_SHARE = 0.1  # of the motion that learning takes to fade in, and out


@dataclass(frozen=True)
class LearningOptions:
    """How an error becomes a correction; None is chosen.

    Attributes:
        gain: Part of the error that one iteration takes away where the plant follows at once.
        shift: Of the error forwards in time [samples].
        cutoff_hz: Up to which frequency is learnt [Hz].
        lead: Time that learning takes to fade in at the start and out at the end [s].
        monotone: Refuse a law that converges, but not in every single iteration.
    """

    gain: float = 0.9
    shift: int | None = None
    cutoff_hz: float | None = None
    lead: float | None = None
    monotone: bool = True


@dataclass(frozen=True, eq=False)
class LearningStep(Shown):
    """The next correction, and what is known of the learning.

    Attributes:
        joints: Drives.
        dt: Sampling step [s].
        error: Reference less position in the trial (N, m) [m or rad].
        previous: The correction that was in force (N, m).
        correction: The next one (N, m).
        expected: Error of the next trial as the actuators' models expect it (N, m).
        full: Where learning acts fully.
        convergence: What was checked before.
        gain: Of L.
        shift: Of L [samples].
        cutoff_hz: Of Q [Hz].
    """

    joints: tuple[str, ...]
    dt: float
    error: np.ndarray
    previous: np.ndarray
    correction: np.ndarray
    expected: np.ndarray
    full: slice
    convergence: Convergence
    gain: float
    shift: int
    cutoff_hz: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Axes whose error would grow in the next trial."""
        now, then = self.rms(self.error), self.rms(self.expected)
        return tuple(
            f"{j}: the next trial's error is expected at {b:.3g}, this one's is {a:.3g}; what is left does not repeat, or the "
            "actuators' models are off"
            for j, a, b in zip(self.joints, now, then, strict=True)
            if b > a
        )

    def rms(self, x: np.ndarray) -> np.ndarray:
        """Return the root mean square (m,) where learning acts fully."""
        return np.sqrt(np.mean(x[self.full] ** 2, axis=0))

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one row a drive: errors [m or rad] and corrections."""
        columns = zip(
            self.joints,
            self.rms(self.error),
            self.rms(self.expected),
            np.abs(self.previous).max(axis=0),
            np.abs(self.correction).max(axis=0),
            strict=True,
        )
        names = ("joint", "error_rms", "expected_error_rms", "largest_previous_correction", "largest_correction")
        return [dict(zip(names, row, strict=True)) for row in columns]


def compute_learning_step(
    actuators: Sequence[Actuator],
    joints: Sequence[str],
    dt: float,
    reference: np.ndarray,
    position: np.ndarray,
    previous: np.ndarray | None = None,
    options: LearningOptions = LearningOptions(),
) -> LearningStep:
    """Return the next correction of the drives' references.

    Args:
        actuators: Model of each drive.
        joints: Their names.
        dt: Sampling step [s].
        reference: The motion without any correction (N, m) [m or rad].
        position: Measured positions of the trial, on the same clock (N, m).
        previous: The correction that was in force (N, m); None for none.
        options: Of the law.

    Raises:
        InputError: Shapes differ, the motion is too short, or learning would not converge.
    """
    if position.shape != reference.shape or (previous is not None and previous.shape != reference.shape):
        raise InputError(
            "mismatch",
            f"reference, trial and correction have the same samples of {len(joints)} joints, not {reference.shape}, "
            f"{position.shape}{'' if previous is None else f', {previous.shape}'}",
        )
    n = len(reference)
    lead = max(1, round((_LEAD_SHARE * n * dt if options.lead is None else options.lead) / dt))
    motion = Reference(dt, reference, np.zeros((n, 3)), first=lead, last=n - lead, lead=lead)
    side = MotorSide(stack_controlled_actuators(actuators, dt))
    shift = options.shift
    if shift is None:
        shift = max(round(np.mean([(a.delay + a.time_constant) / dt for a in actuators])), 0)
    law, cutoff, convergence = _choose_law(side, motion, shift, options)
    require_convergence(convergence, monotone=options.monotone)
    error = reference - position
    u = np.zeros_like(reference) if previous is None else previous
    after = law.update(motion, u, error)
    moved = (side.operator(n) @ (after - u).T.ravel()).reshape(len(joints), -1).T
    return LearningStep(
        tuple(joints), dt, error, u, after, error - moved, motion.full, convergence,
        options.gain, shift, cutoff,
    )  # fmt: skip


def _choose_law(
    side: MotorSide, motion: Reference, shift: int, options: LearningOptions
) -> tuple[LearningLaw, float, Convergence]:
    """Return the law that is asked for, or the one with the highest cutoff [Hz] that is monotone; the cutoff; its convergence."""
    given = options.cutoff_hz
    tried = [given] if given is not None else [f for f in _CUTOFFS_HZ if f < 0.4 / side.dt]
    if not tried:
        raise InputError("invalid_value", f"a sample every {side.dt:g} s is too slow to learn from")
    for cutoff in tried:
        filters = (design_low_pass(cutoff, side.dt),) * motion.q.shape[1]
        law = LearningLaw(side, filters, TimeShift(options.gain, shift, side.dt))
        picture = compute_frequency_condition(law)
        if cutoff != tried[-1] and picture is not None and picture.worst[1] >= 1:
            continue
        found = analyse_convergence(law, motion)
        if found.monotone:
            break
    return law, cutoff, found
