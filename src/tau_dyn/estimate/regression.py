"""A linear regression `y = W theta + noise` with named columns, named outputs, and runs that are never joined.

Plain arrays that can be inspected before anybody trusts `theta`. A run is one stretch of one log, evenly sampled; each of
its outputs has its own mask of usable samples. Torque, pose and vibration measurements all end in this form.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.estimate.sufficient_statistics import SufficientStatistics
from tau_dyn.parameters import Parameters


@dataclass(frozen=True, eq=False)
class RegressionRun:
    """One stretch of evenly sampled data.

    Attributes:
        name: The log it came from.
        t: Time (n,) [s].
        W: Columns (n, m, p), filtered like `y`.
        y: Measured outputs (n, m).
        usable: Which samples of which output the fit may use (n, m).
        W_all: The columns without any sample left out (n, m, p), for judging a model where the fit does not look.
        y_all: The outputs alike (n, m).
        signals: What else a report may want to draw, each (n, m): `q`, `v`, `a`, ...
    """

    name: str
    t: np.ndarray
    W: np.ndarray
    y: np.ndarray
    usable: np.ndarray
    W_all: np.ndarray
    y_all: np.ndarray
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    def window(self, part: slice) -> RegressionRun:
        """Return a stretch of it."""
        signals = {name: x[part] for name, x in self.signals.items()}
        W, y, usable, W_all, y_all = (x[part] for x in (self.W, self.y, self.usable, self.W_all, self.y_all))
        return RegressionRun(self.name, self.t[part], W, y, usable, W_all, y_all, signals)


class RegressionRows(NamedTuple):
    """A stretch of a run's rows: time (n,) [s], columns (n, m, p), outputs (n, m), and which a fit may use (n, m)."""

    t: np.ndarray
    W: np.ndarray
    y: np.ndarray
    usable: np.ndarray


@dataclass(frozen=True, eq=False)
class StreamedData:
    """What there is beyond the runs that are kept in memory, where a recording is larger than that.

    Attributes:
        used: Totals of the rows that a fit may use.
        whole: Totals of all rows.
        runs: Of every run, its rows in order, read back piece by piece.
    """

    used: SufficientStatistics
    whole: SufficientStatistics
    runs: Sequence[Sequence[RegressionRows]]


@dataclass(frozen=True, eq=False)
class Regression:
    """A stacked linear problem.

    Attributes:
        parameters: One per column, with nominal values, bounds and freedom.
        outputs: Names of the outputs (the actuated joints, for torques).
        units: Units of the outputs.
        runs: The data; of a recording too large for memory, excerpts to look at.
        settings: How the data were prepared, for the report.
        everything: Where `runs` are excerpts, all data; else None. Estimates and errors are of all data.
    """

    parameters: Parameters
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    runs: tuple[RegressionRun, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    everything: StreamedData | None = None

    @property
    def n_samples(self) -> int:
        """Number of usable scalar measurements."""
        if self.everything is not None:
            return int(self.everything.used.count.sum())
        return int(sum(run.usable.sum() for run in self.runs))

    @property
    def used_share(self) -> float:
        """Share of the scalar measurements that the fit uses."""
        if self.everything is not None:
            return self.n_samples / max(1, int(self.everything.whole.count.sum()))
        return self.n_samples / max(1, sum(run.usable.size for run in self.runs))

    def totals(self, *, whole: bool = False) -> SufficientStatistics:
        """Return the totals of the rows that a fit may use, or of all rows."""
        if self.everything is not None:
            return self.everything.whole if whole else self.everything.used
        total = SufficientStatistics.zero(len(self.outputs), len(self.parameters))
        for run in self.runs:
            total = total + (
                SufficientStatistics.of(run.W_all, run.y_all)
                if whole
                else SufficientStatistics.of(run.W, run.y, run.usable)
            )
        return total

    def rows(self) -> Iterator[Iterator[RegressionRows]]:
        """Yield every run as its rows in order, in one piece or, of a large recording, in several."""
        if self.everything is not None:
            yield from (iter(run) for run in self.everything.runs)
        else:
            yield from (iter([RegressionRows(run.t, run.W, run.y, run.usable)]) for run in self.runs)

    def stacked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the usable rows, output by output within each run: `W` (N, p), `y` (N,), output index (N,)."""
        rows = [(run.W[run.usable[:, k], k], run.y[run.usable[:, k], k], np.full(run.usable[:, k].sum(), k))
                for run in self.runs for k in range(len(self.outputs))]  # fmt: skip
        W, y, index = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return W, y, index

    def residuals(self, theta: np.ndarray) -> list[np.ndarray]:
        """Return measured minus predicted for each run (n, m), at a full parameter vector (p,)."""
        return [run.y - run.W @ theta for run in self.runs]

    def residuals_all(self, theta: np.ndarray) -> list[np.ndarray]:
        """Return measured minus predicted with no sample left out (n, m), of each run."""
        return [run.y_all - run.W_all @ theta for run in self.runs]

    def with_parameters(self, parameters: Parameters) -> Regression:
        """Return the same data with other values, bounds or freedoms."""
        return replace(self, parameters=parameters)
