"""Hypotheses of changes within a log, and the log with the changes found in the model.

A change of a factor divides the forces after it; every other change is a step of columns at its time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from tau_dyn.estimate import Regression, RegressionRun

Kind = Literal["sign", "gain", "friction", "offset", "payload", "gravity_direction"]
Columns = Sequence[np.ndarray]
DRIFT_TIME_SHARES = (0.03, 0.1, 0.3, 1.0)
"""Time constants of a drift over the log's length; a linear drift is an exponential one of infinite time constant."""
MEMORY_PERIODS = 2.0
"""Half-width of a step after the fit's low-pass, in periods of its cutoff: 0.3 % of the step remain after it."""
MEMORY_ROWS = 2
"""Rows on both sides of a change that are left out if no low-pass is known."""


class Hypothesis(NamedTuple):
    """A change of one kind: its output (-1 for all), and columns (n, m, d) of each run; an empty list for a factor."""

    kind: Kind
    output: int
    columns: Columns


class LogData(NamedTuple):
    """One log with all changes found so far in the model.

    Attributes:
        regression: The runs of this log.
        factors: Joint, time [s] and factor of forces that changed by a factor.
        steps: Columns (n, m, d) of each run of the other changes.
        times: Times of the changes whose transition is left out [s].
    """

    regression: Regression
    factors: tuple[tuple[int, float, float], ...] = ()
    steps: tuple[Columns, ...] = ()
    times: tuple[float, ...] = ()

    @property
    def runs(self) -> tuple[RegressionRun, ...]:
        """The runs with forces divided by the factors found."""
        found = []
        for run in self.regression.runs:
            y, usable = run.y.copy(), run.usable.copy()
            for output, time_s, factor in self.factors:
                y[run.t > time_s, output] /= factor
            for time_s in self.times:
                usable[np.abs(run.t - time_s) < self.memory_s] = False
            found.append(replace(run, y=y, usable=usable))
        return tuple(found)

    @property
    def columns(self) -> list[np.ndarray]:
        """The model's columns and those of the changes found (n, m, p) of each run."""
        runs = self.regression.runs
        return [np.concatenate([run.W, *(step[r] for step in self.steps)], axis=2) for r, run in enumerate(runs)]

    @property
    def memory_s(self) -> float:
        """Time over which the fit's low-pass smooths a step [s]."""
        cutoff = self.regression.preparation.force_cutoff_hz
        step = max((float(np.median(np.diff(run.t))) for run in self.regression.runs if len(run.t) > 1), default=0.0)
        return max(MEMORY_PERIODS / cutoff, MEMORY_ROWS * step)

    def take(self, hypothesis: Hypothesis, time_s: float, factor: float) -> LogData:
        """Return the log with one more change in the model."""
        if hypothesis.columns:
            step = [c * (run.t > time_s)[:, None, None] for c, run in zip(hypothesis.columns, self.runs, strict=True)]
            return self._replace(steps=(*self.steps, step))
        return self._replace(factors=(*self.factors, (hypothesis.output, time_s, factor)))

    def drift(self, hypothesis: Hypothesis, number: int) -> LogData:
        """Return the log with a drift of a hypothesis' columns in the model; unchanged for a factor."""
        if not hypothesis.columns:
            return self
        ends = min(run.t[0] for run in self.runs), max(run.t[-1] for run in self.runs)
        shapes = [list_drifts(run.t, *map(float, ends))[number] for run in self.runs]
        drift = [c * x[:, None, None] for c, x in zip(hypothesis.columns, shapes, strict=True)]
        return self._replace(steps=(*self.steps, drift))

    def leave_out(self, time_s: float) -> LogData:
        """Return the log without the samples about a change."""
        return self._replace(times=(*self.times, time_s))


def list_hypotheses(regression: Regression, shared: Mapping[Kind, Columns]) -> list[Hypothesis]:
    """Return all kinds of changes: of each joint, and of all joints together."""
    found = [Hypothesis(kind, -1, columns) for kind, columns in shared.items()]
    for k in range(len(regression.outputs)):
        if not any(run.usable[:, k].any() for run in regression.runs):
            continue
        constant = [np.ones((len(run.t), 1)) for run in regression.runs]
        found += [Hypothesis("sign", k, ()), Hypothesis("gain", k, ())]
        found.append(Hypothesis("offset", k, _place_at_output(regression, k, constant)))
        found.append(Hypothesis("friction", k, _place_at_output(regression, k, _make_friction(regression, k))))
    return found


def _place_at_output(regression: Regression, output: int, columns: Columns) -> list[np.ndarray]:
    """Return columns (n, m, d) that are zero at all outputs except one, at which they are given (n, d)."""
    found = []
    for run, x in zip(regression.runs, columns, strict=True):
        made = np.zeros((len(run.t), len(regression.outputs), x.shape[1]))
        made[:, output] = x
        found.append(made)
    return found


def _make_friction(regression: Regression, output: int) -> list[np.ndarray]:
    """Return Coulomb friction (n, 1) of one joint, filtered as in the fit if the model has it: a brake or contact adds it."""
    joint, found = regression.outputs[output], []
    own = [k for k, name in enumerate(regression.parameters.names) if name.startswith(f"{joint}.coulomb")]
    for run in regression.runs:
        found.append(run.W[:, output, own].sum(axis=1)[:, None] if own else np.sign(run.signals["v"][:, [output]]))
    return found


def list_drifts(t: np.ndarray, begin: float | None = None, end: float | None = None) -> list[np.ndarray]:
    """Return the shapes (n,) of drifts at times (n,) [s] of a log: linear, then exponential with each time constant."""
    first, last = float(t.min() if begin is None else begin), float(t.max() if end is None else end)
    since = (t - first) / max(last - first, 1e-9)
    return [since, *(np.exp(-since / share) for share in DRIFT_TIME_SHARES)]
