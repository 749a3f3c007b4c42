r"""By what part of a sample forces were logged late or early, and what that does to the parameters' intervals.

A force that is held over a sample and logged at the start of its hold stands half a sample before its effect. With the
predicted force `F`, forces logged late by `delta` are `tau_log(t) = tau(t) - delta dF/dt`, so `delta` is one more column of the
regression, `-dF/dt`, with the prior that nothing is later than about a sample. Where the data show an offset, the forces are
read that much later (linearisation of the time delay, Ljung 1999, 14.4); its standard error widens every interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.effects import Delay
from tau_dyn.estimate import Estimate, PhysicalConstraints, Regression, build_prior_rows, solve_least_squares
from tau_dyn.exceptions import InputError
from tau_dyn.identify.regression import prepare_segment
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters

PRIOR_SAMPLES = 0.5
"""Standard deviation of the offset before the data, in samples: half a sample is what a hold makes of it."""
MAX_SAMPLES = 1.5
"""Largest offset that is corrected; more is no matter of a hold, and is warned of (`force_late`)."""
MIN_Z = 4.0
"""Standard errors from which an offset is corrected: one log in 15,000 by chance."""
MIN_SAMPLES = 0.02
"""Smallest offset that is corrected; less changes nothing that anybody reads."""
_NAME = "drive.delay"


@dataclass(frozen=True)
class ForceOffset:
    """How late forces were logged.

    Attributes:
        seconds: The offset; positive where forces were logged late [s].
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
        return size > MIN_Z * self.stderr and MIN_SAMPLES * self.period_s < size < MAX_SAMPLES * self.period_s

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "force_offset_s": self.seconds,
            "stderr_s": self.stderr,
            "force_offset_samples": self.seconds / self.period_s,
            "corrected": self.corrected,
        }


def build_offset_columns(model: Model, pieces: Sequence[Log], regression: Regression) -> list[np.ndarray] | None:
    """Return the force per second of offset (n, na) of each run, filtered and masked as the regression; None where it has none.

    Args:
        model: The fitted model.
        pieces: Even stretches of the logs, one a run.
        regression: The regression on them.
    """
    if len(pieces) != len(regression.runs) or any(effect.measured for effect in model.effects):
        return None
    found = []
    effect = Delay(model.robot.actuated, model.robot.force_units, about=max(piece.dt for piece in pieces))
    for piece, run in zip(pieces, regression.runs, strict=True):
        try:
            made = prepare_segment(model, piece, regression.settings["preparation"], needs=("force",))
        except InputError:
            return None  # an effect feels more than the piece alone says
        column = made.columns(effect.columns(made.motion))[:, :, 0]
        if column.shape != run.y.shape:
            return None
        found.append(column)
    return found


def estimate_offset(
    regression: Regression, columns: Sequence[np.ndarray], period_s: float, physics: PhysicalConstraints | None
) -> ForceOffset:
    """Return the offset, estimated beside all free parameters by weighted least squares.

    Args:
        regression: The regression.
        columns: What `build_offset_columns` returned.
        period_s: Time between samples of the logs [s].
        physics: What makes the parameters physical.
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


def shift_forces(log: Log, joints: Sequence[str], seconds: float) -> Log:
    """Return a log whose forces are read `seconds` later, by cubic interpolation; its ends keep their last value."""
    t = np.clip(log.t + seconds, log.t[0], log.t[-1])
    names = [f"tau_{joint}" for joint in joints]
    return replace(log, channels={**log.channels, **{n: CubicSpline(log.t, log.channels[n])(t) for n in names}})


def widen_by_offset(estimate: Estimate, columns: Sequence[np.ndarray], offset: ForceOffset) -> Estimate:
    """Return the estimate with intervals that hold for any offset within its standard error.

    The base parameters move by `W^+ (-dF/dt)` a second of offset, in weighted rows.
    """
    base, parameters = estimate.base, estimate.regression.parameters
    kept = [parameters.names.index(base.names[c]) for c in base.kept]
    rows, target = [], []
    for run, x in zip(estimate.regression.runs, columns, strict=True):
        use = run.usable
        rows.append((run.W[:, :, kept] / estimate.sigma[:, None])[use])
        target.append((x / estimate.sigma)[use])
    known, _ = build_prior_rows(parameters.select(base.names))  # what was measured beforehand does not move
    W = np.concatenate([*rows, known[:, base.kept]])
    norm = np.where((size := np.linalg.norm(W, axis=0)) > 0, size, 1.0)
    slope = np.linalg.lstsq(W / norm, np.concatenate([*target, np.zeros(len(known))]), rcond=1e-10)[0] / norm
    more = np.outer(slope, slope) * offset.stderr**2
    wider = replace(estimate, cov=estimate.cov + more, scatter=estimate.scatter + more)
    alone = base.by_name(wider.stderr)
    changes = {name: {"stderr": x} for name, x in alone.items() if estimate.parameters[name].stderr is not None}
    return replace(wider, parameters=estimate.parameters.update(changes))
