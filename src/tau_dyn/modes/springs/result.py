"""Result of `find_springs`: springs with standard errors, the fit of each record, and the robot that has these springs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.estimate import MAX_RELATIVE_STDERR
from tau_dyn.mechanism import write_springs
from tau_dyn.results import Z95, Brief, Shown, to_plain

if TYPE_CHECKING:
    from tau_dyn.robot import Robot, Spring


@dataclass(frozen=True)
class FittedSpring(Brief):
    """One spring.

    Attributes:
        spring: Joint, stiffness and damping [N/m, N s/m or N m/rad, N m s/rad], with the stiffness' standard error.
        damping_stderr: Standard error of the damping.
        unit: Unit of the stiffness.
        of_drive: Whether it lies between drive and link.
        nominal: Stiffness in the robot file; None if the file has no such spring.
    """

    spring: Spring
    damping_stderr: float
    unit: str
    of_drive: bool
    nominal: float | None

    @property
    def stiffness_stderr(self) -> float:
        """Standard error of the stiffness."""
        return float(self.spring.stiffness_stderr or 0.0)

    @property
    def identified(self) -> bool:
        """Whether the records determine the stiffness: its standard error is below 30 %."""
        return self.stiffness_stderr < MAX_RELATIVE_STDERR * self.spring.stiffness

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval of the stiffness, symmetric in its logarithm, as the fit is."""
        k, ratio = self.spring.stiffness, self.stiffness_stderr / self.spring.stiffness
        return k * float(np.exp(-Z95 * ratio)), k * float(np.exp(Z95 * ratio))


@dataclass(frozen=True)
class RecordFit(Brief):
    """How well the springs reproduce one record.

    Attributes:
        log: Name of the log.
        q: Actuated positions (na,) [m or rad].
        fit_percent: `100 (1 - |y - y_hat| / |y|)` of each output over the used lines (p,).
        resonances_hz: Undamped natural frequencies with the drives held, within the band of the record [Hz].
        held_out: Whether the springs were not fitted to it.
    """

    log: str
    q: tuple[float, ...]
    fit_percent: tuple[float, ...]
    resonances_hz: tuple[float, ...]
    held_out: bool


@dataclass(frozen=True, eq=False)
class SpringFit(Shown):
    """The answer of `find_springs`.

    Attributes:
        robot: The robot without the fitted springs.
        springs: Fitted springs, those of drives last.
        correlation: Correlation of the stiffnesses' errors (ns, ns).
        inputs: Columns that excite.
        outputs: Columns that respond.
        records: Fit of each record.
        iterations: Steps of the last fit.
        converged: Whether the last step was small against the standard errors.
        warnings: Doubts about the result, one sentence each.
        seed: Kept with the result; the method is deterministic.
    """

    robot: Robot
    springs: tuple[FittedSpring, ...]
    correlation: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    records: tuple[RecordFit, ...]
    iterations: int
    converged: bool
    warnings: tuple[str, ...] = ()
    seed: int = 0

    def list_identified(self) -> list[str]:
        """Return the joints whose stiffness the records determine."""
        return [s.spring.joint for s in self.springs if s.identified]

    def list_not_identified(self) -> list[str]:
        """Return the joints whose stiffness no record determines."""
        return [s.spring.joint for s in self.springs if not s.identified]

    def build_robot(self) -> Robot:
        """Return the robot with these springs in its file."""
        passive = [s.spring for s in self.springs if not s.of_drive]
        return write_springs(self.robot, passive, [s.spring for s in self.springs if s.of_drive])

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result."""
        rows = [
            {
                "joint": s.spring.joint,
                "kind": "drive" if s.of_drive else "joint",
                "unit": s.unit,
                "stiffness": s.spring.stiffness,
                "stiffness_stderr": s.stiffness_stderr,
                "stiffness_ci95": list(s.ci95),
                "damping": s.spring.damping,
                "damping_stderr": s.damping_stderr,
                "identified": s.identified,
                "nominal": s.nominal,
            }
            for s in self.springs
        ]
        return {
            "springs": rows,
            "not_identified": self.list_not_identified(),
            "correlation": self.correlation.tolist(),
            "inputs_used": list(self.inputs),
            "outputs_used": list(self.outputs),
            "records": to_plain(self.records),
            "iterations": self.iterations,
        }
