"""Iterative learning control: repeat a motion, and add to its reference what the last error asks for (thesis chapter 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tau_dyn.control.iterative.convergence_analysis import Convergence, analyse_convergence, require_convergence
from tau_dyn.control.iterative.laws import UpdateLaw
from tau_dyn.control.iterative.learned_outputs import Reference, TrialMeasurement
from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class LearningHistory:
    """Errors and corrections of all trials; the first has no correction.

    Attributes:
        motion: What was repeated.
        convergence: What was known beforehand.
        corrections: Of each trial (k + 1, N, m).
        errors: What was learnt from, r less its estimate (k + 1, N, m).
        motor_errors: Actuator references less measured positions (k + 1, N, na), thesis (7.23).
        tool_errors: The tool's reference less its measured position (k + 1, N, 3) [m], thesis (7.24).
    """

    motion: Reference
    convergence: Convergence
    corrections: np.ndarray
    errors: np.ndarray
    motor_errors: np.ndarray
    tool_errors: np.ndarray

    def relative(self, which: str = "errors") -> np.ndarray:
        """Return (7.25), each trial's error in percent of the first one's (k + 1, m), where learning acts fully.

        Args:
            which: 'errors', 'motor_errors' or 'tool_errors'.
        """
        size = np.linalg.norm(getattr(self, which)[:, self.motion.full], axis=1)
        return 100 * size / np.where(size[0] > 0, size[0], 1.0)

    def rms(self, which: str = "errors") -> np.ndarray:
        """Return root mean squares (k + 1, m) where learning acts fully."""
        return np.sqrt(np.mean(getattr(self, which)[:, self.motion.full] ** 2, axis=1))


class TrialPlant(Protocol):
    """A robot with its controller, or a simulation of both: `simulate.LearningPlant`."""

    @property
    def dt(self) -> float:
        """Step of references and sensors [s]."""
        ...

    def run(self, reference: np.ndarray, trial: int) -> TrialMeasurement:
        """Move along actuator references (N, na), from rest, and return what the sensors showed."""
        ...


def learn(
    plant: TrialPlant,
    motion: Reference,
    law: UpdateLaw,
    iterations: int = 10,
    *,
    monotone: bool = True,
    limit: float | None = None,
    first_trial: int = 0,
) -> LearningHistory:
    """Learn a motion.

    Args:
        plant: What moves.
        motion: What is repeated.
        law: How errors become corrections.
        iterations: Trials with a correction; one without goes before.
        monotone: Refuse a law that converges, but not in every single iteration, (7.16).
        limit: Largest correction that may be sent [m or rad]; by default the size of the motion.
        first_trial: Number of the first trial; another one meets other disturbances.

    Raises:
        InputError: The law would not converge, sampling steps differ, or a correction is larger than the limit.
    """
    if abs(plant.dt - motion.dt) > 1e-9 * motion.dt:
        raise InputError(
            "mismatch",
            f"the robot takes references every {1000 * plant.dt:g} ms, the motion has one every {1000 * motion.dt:g} ms",
        )
    if iterations < 1:
        raise InputError("invalid_value", "learning takes at least one iteration")
    before = analyse_convergence(law, motion)
    require_convergence(before, monotone=monotone)
    wanted = law.side.reference(motion)
    allowed = float(np.ptp(wanted, axis=0).max()) if limit is None else limit
    u = np.zeros_like(wanted)
    kept: list[tuple[np.ndarray, ...]] = []
    for k in range(iterations + 1):
        _require_small(u, allowed, k)
        trial = plant.run(law.side.commands(motion, u), first_trial + k)
        error = wanted - law.side.estimate(trial)
        kept.append((u, error, motion.q - trial.q, motion.tool - trial.tool))
        u = law.update(motion, u, error)
    return LearningHistory(motion, before, *(np.array(part) for part in zip(*kept, strict=True)))


def _require_small(u: np.ndarray, allowed: float, k: int) -> None:
    size = float(np.abs(u).max(initial=0.0))
    if not size <= allowed:
        raise InputError(
            "invalid_value",
            f"iteration {k} asks for a correction of {size:.3g}, more than the {allowed:.3g} allowed; the robot does not do what "
            "its model says, or the limit is too low",
        )
