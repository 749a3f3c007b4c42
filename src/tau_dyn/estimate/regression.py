"""A linear regression `y = W theta + noise` with named columns, named outputs, and runs that are never joined.

Plain arrays that can be inspected before anybody trusts `theta`. A run is one stretch of one log, evenly sampled; each of
its outputs has its own mask of usable samples. Torque, pose and vibration measurements all end in this form.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tau_dyn.parameters import Parameters


@dataclass(frozen=True, eq=False)
class Run:
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

    def window(self, part: slice) -> Run:
        """Return a stretch of it."""
        signals = {name: x[part] for name, x in self.signals.items()}
        W, y, usable, W_all, y_all = (x[part] for x in (self.W, self.y, self.usable, self.W_all, self.y_all))
        return Run(self.name, self.t[part], W, y, usable, W_all, y_all, signals)

    def segments(self, output: int) -> Iterator[slice]:
        """Yield the unbroken stretches of usable samples of one output."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.usable[:, output].astype(int), [0]])))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            yield slice(int(start), int(stop))


@dataclass(frozen=True, eq=False)
class Regression:
    """A stacked linear problem.

    Attributes:
        parameters: One per column, with nominal values, bounds and freedom.
        outputs: Names of the outputs (the actuated joints, for torques).
        units: Units of the outputs.
        runs: The data.
        settings: How the data were prepared, for the report.
    """

    parameters: Parameters
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    runs: tuple[Run, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        """Number of usable scalar measurements."""
        return int(sum(run.usable.sum() for run in self.runs))

    @property
    def used_share(self) -> float:
        """Share of the scalar measurements that the fit uses."""
        return self.n_samples / max(1, sum(run.usable.size for run in self.runs))

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
