"""A constant offset between the clocks of force and motion, estimated with the parameters; its uncertainty widens the intervals.

A force that is held over a sample and logged at the start of its hold is half a sample before its effect. The offset is one more
column of the regression, `-dF/dt` of the predicted force `F`, with the prior that forces are at most about a sample late. If the
data show an offset, the forces are read that much later (linearisation of the time delay, Ljung 1999, 14.4); its standard error
widens every interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.effects import Delay
from tau_dyn.estimate import Estimate, PhysicalConstraints, Regression, solve_least_squares
from tau_dyn.exceptions import InputError
from tau_dyn.identify.regression import prepare_segment
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters

PRIOR_SAMPLES = 0.5
"""Standard deviation of the offset before the data, in samples: half a sample is the effect of a hold."""
MAX_OFFSET_SAMPLES = 1.5
"""Largest offset that is corrected; a hold does not explain more, which gives a warning (`force_late`)."""
MIN_OFFSET_Z = 4.0
"""Standard errors from which an offset is corrected: one log in 15,000 by chance."""
MIN_OFFSET_SAMPLES = 0.02
"""Smallest offset [samples] that is corrected; less changes no reported digit."""
_NAME = "drive.delay"


@dataclass(frozen=True)
class ForceOffset:
    """Delay of the logged forces.

    Attributes:
        seconds: The offset [s]; positive if forces were logged late.
        stderr: Its standard error [s].
        period_s: Time between samples of the logs [s].
        corrected: Whether forces were read at the shifted times.
    """

    seconds: float
    stderr: float
    period_s: float
    corrected: bool = False

    @property
    def is_shown(self) -> bool:
        """Whether the data show an offset that a hold explains."""
        size = abs(self.seconds)
        return (
            size > MIN_OFFSET_Z * self.stderr
            and MIN_OFFSET_SAMPLES * self.period_s < size < MAX_OFFSET_SAMPLES * self.period_s
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "force_offset_s": self.seconds,
            "stderr_s": self.stderr,
            "force_offset_samples": self.seconds / self.period_s,
            "corrected": self.corrected,
        }


def build_offset_columns(model: Model, pieces: Sequence[Log], regression: Regression) -> list[np.ndarray] | None:
    """Return the force per second of offset (n, na) of each run, filtered and masked as the regression, or None.

    The result is None if the columns cannot be computed: an effect needs measured signals, the base floats, or the pieces do not
    match the runs.

    Args:
        model: The fitted model.
        pieces: Even stretches of the logs, one a run.
        regression: The regression on them.
    """
    if len(pieces) != len(regression.runs) or any(effect.measured for effect in model.effects):
        return None
    if model.robot.base_coordinates:
        return None  # the model's own force lacks the ground's share
    found = []
    effect = Delay(model.robot.actuated, model.robot.force_units, about=max(piece.dt for piece in pieces))
    for piece, run in zip(pieces, regression.runs, strict=True):
        try:
            made = prepare_segment(model, piece, regression.preparation, needs=("force",))
        except InputError:
            return None  # an effect needs more than the piece alone contains
        column = made.columns(effect.columns(made.motion))[:, :, 0]
        if column.shape != run.y.shape:
            return None
        found.append(column)
    return found


def estimate_offset(
    regression: Regression, columns: Sequence[np.ndarray], period_s: float, physics: PhysicalConstraints | None
) -> ForceOffset:
    """Return the offset, estimated together with all free parameters by weighted least squares.

    Args:
        regression: The regression.
        columns: Result of `build_offset_columns`.
        period_s: Time between samples of the logs [s].
        physics: Physical constraints of the parameters; None for bounds alone.
    """
    more = Parameter(_NAME, 0.0, "s", prior_stderr=PRIOR_SAMPLES * period_s, origin="timing")
    runs = tuple(
        replace(
            run,
            W=np.concatenate([run.W, x[:, :, None]], axis=2),
            W_all=np.concatenate([run.W_all, x[:, :, None]], axis=2),
        )
        for run, x in zip(regression.runs, columns, strict=True)
    )
    wide = replace(regression, parameters=regression.parameters + Parameters([more]), runs=runs)
    found = solve_least_squares(wide, physics=physics).parameters[_NAME]
    return ForceOffset(found.value, found.stderr or PRIOR_SAMPLES * period_s, period_s)


def widen_by_offset(estimate: Estimate, columns: Sequence[np.ndarray], offset: ForceOffset) -> Estimate:
    """Return the estimate with standard errors that include the offset's.

    The change of the base parameters per second of offset is a fit of `-dF/dt`.
    """
    base, slope = estimate.base, estimate.refit(columns)
    more = np.outer(slope, slope) * offset.stderr**2
    wider = replace(estimate, cov=estimate.cov + more, scatter=estimate.scatter + more)
    alone = base.by_name(wider.stderr)
    changes = {name: {"stderr": x} for name, x in alone.items() if estimate.parameters[name].stderr is not None}
    return replace(wider, parameters=estimate.parameters.update(changes))
