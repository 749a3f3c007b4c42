"""A linear regression `y = W theta + noise` with named columns, named outputs, and runs that are never joined.

The data are plain arrays that can be inspected. A run is one stretch of one log, evenly sampled; each of
its outputs has its own mask of usable samples. Torque, pose and vibration measurements all end in this form.

Least squares needs only the triangular factor of each output's columns and measurements, for any number of rows: with
`[W_k y_k] = Q_k R_k`, `R_k` (p + 1, p + 1) gives every weighted fit of these rows and every residual's size,
`|y_k - W_k theta| = |R_k [-theta; 1]|`, whatever the outputs' weights. Factors of blocks of rows are stacked and factored again,
so rows may come in any number and be discarded; unlike the normal equations this keeps all digits. Rows that a covariance needs
and that exceed memory are in an anonymous temporary file. Reference: Golub & Van Loan 2013, 5.2 and 6.5 (updating);
Demmel et al. 2012 (tall-skinny QR).
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import lapack

from tau_dyn.parameters import Parameters
from tau_dyn.results import Brief

_FACTORED_ROWS = 4096
"""Rows factored at once; more do not fit the processor's cache."""


@dataclass(frozen=True, eq=False)
class SufficientStatistics:
    """Rows of m outputs and p columns, summed up.

    Attributes:
        R: Triangular factors of `[W y]` (m, p + 1, p + 1).
        sums: Sums of the rows `[W y]` (m, p + 1).
        count: Number of rows (m,).
    """

    R: np.ndarray
    sums: np.ndarray
    count: np.ndarray

    @classmethod
    def zero(cls, n_outputs: int, n_columns: int) -> SufficientStatistics:
        """Return totals without rows."""
        k = n_columns + 1
        return cls(np.zeros((n_outputs, k, k)), np.zeros((n_outputs, k)), np.zeros(n_outputs, int))

    @classmethod
    def of(cls, W: np.ndarray, y: np.ndarray, usable: np.ndarray | None = None) -> SufficientStatistics:
        """Return the totals of columns (n, m, p) and measurements (n, m), of usable samples (n, m) if given."""
        n, m, p = W.shape
        found = cls.zero(m, p)
        for k in range(m):
            columns, measured = W[:, k].T, y[:, k]
            if usable is not None and not usable[:, k].all():
                columns, measured = columns[:, usable[:, k]], measured[usable[:, k]]
            found.R[k], found.sums[k] = (
                compute_triangular_factor(columns.T, measured),
                [*columns.sum(axis=1), measured.sum()],
            )
            found.count[k] = len(measured)
        return found

    def __add__(self, other: SufficientStatistics) -> SufficientStatistics:
        """Return the totals of these rows and others."""
        both = np.concatenate([self.R, other.R], axis=1)
        R = np.stack([_factor(np.asfortranarray(rows)) for rows in both]) if len(both) else self.R
        return SufficientStatistics(R, self.sums + other.sums, self.count + other.count)

    def scaled(self, factors: Sequence[float]) -> SufficientStatistics:
        """Return the totals with each output's measurements multiplied by a factor."""
        R, sums = self.R.copy(), self.sums.copy()
        R[:, :, -1] *= np.asarray(factors)[:, None]
        sums[:, -1] *= factors
        return SufficientStatistics(R, sums, self.count)

    def squares(self, theta: np.ndarray) -> np.ndarray:
        """Return the sum of squared residuals of each output (m,) at a parameter vector (p,)."""
        return np.sum((self.R[:, :, -1] - self.R[:, :, :-1] @ theta) ** 2, axis=1)

    def power(self) -> np.ndarray:
        """Return the sum of squared measurements of each output (m,)."""
        return np.sum(self.R[:, :, -1] ** 2, axis=1)


def compute_triangular_factor(W: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the triangular factor (p + 1, p + 1) of rows `[W y]`, W (n, p) and y (n,); columns of zeros take no time."""
    p = W.shape[1]
    used = np.flatnonzero(W.any(axis=0)) if len(W) else np.zeros(0, int)
    small = np.zeros((0, len(used) + 1))
    for start in range(0, len(y), _FACTORED_ROWS):
        part = slice(start, start + _FACTORED_ROWS)
        rows = np.empty(
            (len(used) + 1, len(small) + len(y[part]))
        )  # transposed: LAPACK takes columns one after another
        rows[:, : len(small)] = small.T
        rows[:-1, len(small) :] = W.T[:, part] if len(used) == p else W.T[used, part]
        rows[-1, len(small) :] = y[part]
        small = _factor(rows.T)
    out = np.zeros((p + 1, p + 1))
    place = [*used, p]
    out[np.ix_(place[: len(small)], place)] = small
    return out


def _factor(rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor (min(n, k), k) of rows (n, k) in Fortran order, which are overwritten."""
    factored, _, _, fault = lapack.dgeqrf(rows, overwrite_a=1)
    if fault:
        raise ValueError(f"dgeqrf: argument {-fault}")
    return np.triu(factored[: min(rows.shape)])


@dataclass(frozen=True, eq=False)
class RegressionRun(Brief):
    """One stretch of evenly sampled data.

    Attributes:
        name: The log it came from.
        t: Time (n,) [s].
        W: Columns (n, m, p), filtered like `y`.
        y: Measured outputs (n, m).
        usable: Which samples of which output the fit may use (n, m).
        W_all: The columns without any sample left out (n, m, p), for judging a model at samples that the fit does not use.
        y_all: The outputs, without any sample left out (n, m).
        signals: Further signals for a report, each (n, m): `q`, `v`, `a`, ...
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
    """Data of recordings larger than memory, in addition to the runs that are kept in memory.

    Attributes:
        used: Totals of the rows that a fit may use.
        whole: Totals of all rows.
        runs: The rows of every run in order, read back piece by piece.
    """

    used: SufficientStatistics
    whole: SufficientStatistics
    runs: Sequence[Sequence[RegressionRows]]


ROUNDING = 1e-6
"""Part of a sample or a block; a clock's last digit must not turn five samples into six."""


@dataclass(frozen=True, eq=False)
class Preparation:
    """Filters and masks between a recording and its regression.

    Attributes:
        position_cutoff_hz: Zero-phase low-pass on positions before differentiation [Hz].
        force_cutoff_hz: The one low-pass on forces and on every column [Hz].
        rate_hz: Rate after decimation, at least [Hz].
        speed_threshold: Slowest speed of each joint with a sure sign (na,) [m/s or rad/s].
        window_s: Time gated out on both sides of slow, reversing or excluded samples [s].
        exclude: Columns whose nonzero samples are left out.
    """

    position_cutoff_hz: float
    force_cutoff_hz: float
    rate_hz: float
    speed_threshold: np.ndarray
    window_s: float
    exclude: tuple[str, ...] = ()

    def factor(self, rate_hz: float) -> int:
        """Return the whole number by which a log of this rate is decimated."""
        return max(1, int(rate_hz / self.rate_hz + ROUNDING))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return asdict(self) | {"speed_threshold": self.speed_threshold.tolist(), "exclude": list(self.exclude)}


AS_RECORDED = Preparation(inf, inf, inf, np.zeros(0), 0.0)
"""Preparation of rows without any filter or mask."""


@dataclass(frozen=True, eq=False)
class Regression(Brief):
    """A stacked linear problem.

    Attributes:
        parameters: One per column, with nominal values, bounds and freedom.
        outputs: Names of the outputs (the actuated joints, for torques).
        units: Units of the outputs.
        runs: The data; for a recording too large for memory, excerpts for display.
        preparation: Filters and masks that the rows went through.
        everything: All data if `runs` are excerpts; else None. Estimates and errors are of all data.
    """

    parameters: Parameters
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    runs: tuple[RegressionRun, ...]
    preparation: Preparation = AS_RECORDED
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
        """Yield every run as its rows in order, in one piece or, for a large recording, in several."""
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

    def combine_columns(self, parameters: Parameters, maps: Sequence[np.ndarray]) -> Regression:
        """Return the same data with other parameters, whose columns are combinations of these, in each run of its own.

        Args:
            parameters: The other parameters, k of them.
            maps: For each run, its columns (p) of each new column (p, k).
        """
        runs = [replace(run, W=run.W @ S, W_all=run.W_all @ S) for run, S in zip(self.runs, maps, strict=True)]
        return replace(self, parameters=parameters, runs=tuple(runs))

    def with_parameters(self, parameters: Parameters) -> Regression:
        """Return the same data with other values, bounds or freedoms."""
        return replace(self, parameters=parameters)


class StoredRows:
    """Pieces of runs, each run's in order.

    Attributes:
        n_columns: Columns of all rows.
    """

    def __init__(self, n_columns: int) -> None:
        """Open an empty file."""
        self.n_columns = n_columns
        self._file = tempfile.TemporaryFile(prefix="tau_dyn_")
        weakref.finalize(self, self._file.close)
        self._pieces: list[list[list[_StoredArray]]] = []

    def begin(self) -> None:
        """Begin a new run."""
        self._pieces.append([])

    def add(self, rows: RegressionRows) -> None:
        """Write a piece of the run that was begun last."""
        arrays = [rows.t, rows.usable, rows.y]
        for k in range(rows.y.shape[1]):
            touching = np.flatnonzero(rows.W[:, k].any(axis=0))
            arrays += [touching, rows.W[:, k, touching]]
        self._pieces[-1].append([self._write(array) for array in arrays])

    @property
    def runs(self) -> Sequence[Sequence[RegressionRows]]:
        """Every run as its pieces, read when they are asked for."""
        return tuple(_StoredRun(self, pieces) for pieces in self._pieces)

    def read(self, piece: list[_StoredArray]) -> RegressionRows:
        """Return a piece of the file."""
        t, usable, y, *columns = (self._read(array) for array in piece)
        W = np.zeros((*y.shape, self.n_columns))
        for k, (touching, values) in enumerate(zip(columns[::2], columns[1::2], strict=True)):
            W[:, k, touching] = values
        return RegressionRows(t, W, y, usable)

    def _write(self, array: np.ndarray) -> _StoredArray:
        self._file.seek(0, 2)
        stored = _StoredArray(self._file.tell(), array.nbytes, array.dtype, array.shape)
        self._file.write(array.tobytes())
        return stored

    def _read(self, stored: _StoredArray) -> np.ndarray:
        self._file.seek(stored.place)
        return np.frombuffer(self._file.read(stored.n_bytes), stored.dtype).reshape(stored.shape)


class _StoredArray(NamedTuple):
    """Where an array lies in the file, and what it is."""

    place: int
    n_bytes: int
    dtype: np.dtype
    shape: tuple[int, ...]


class _StoredRun(Sequence[RegressionRows]):
    """One run's pieces."""

    def __init__(self, stored: StoredRows, pieces: list[list[_StoredArray]]) -> None:
        self._stored, self._pieces = stored, pieces

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, index):
        return self._stored.read(self._pieces[index])

    def __iter__(self) -> Iterator[RegressionRows]:
        return (self._stored.read(piece) for piece in self._pieces)
