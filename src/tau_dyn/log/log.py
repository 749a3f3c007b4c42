"""A recording, measured or simulated: one clock and named channels.

`t` [s] increases strictly; each channel is a column of the file under the contract's name (`q_J`, `tau_J`, ... in SI
units). All arrays are read-only, so a log can be shared, split and windowed without copies. Functions of a `Log`
work in the same way on recorded and simulated data. See `read.py` for reading, `resample.py` for an even clock,
`filtering.py` for filters.
"""

import csv
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tau_dyn.exceptions import InputError, require_kind
from tau_dyn.files import write_atomically
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import ROOM_TEMPERATURE, describe_missing_column, map_joints
from tau_dyn.parameters import as_numbers
from tau_dyn.results import Shown, count

if TYPE_CHECKING:
    import pandas as pd

_ROWS_AT_ONCE = 10_000  # of a CSV; a megabyte or two of text
_NAME_IT = "; log it, or name its column in a column map"


@dataclass(frozen=True, eq=False)
class Origin:
    """Origin of a log's columns.

    Attributes:
        column_map: The column map; None for a log under our own names.
        without_numbers: Columns of ours whose every cell is empty or `nan`, which the log therefore lacks.
    """

    column_map: ColumnMap | None = None
    without_numbers: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Log(Shown):
    """Time and named channels of one recording.

    Attributes:
        t: Time (N,) [s], finite and strictly increasing, read-only.
        channels: Every other column by its name, each (N,) float64 and read-only; foreign columns may hold NaN.
        name: File name for messages, or the name that the simulator gave.
        sha256: Hash of the bytes of the file or files; empty for a simulated log.
        warnings: Doubts found while reading, one sentence each.
        origin: Origin of its columns.

    Example:
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> log = td.Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, "monday.csv")
        >>> log[100:200]
        Log: monday.csv
          0.99 s at 100 Hz, 100 samples; axis.
        >>> len(log[2.0:3.0]), float(log["q_axis"].max() <= 1.0)
        (100, 1.0)
    """

    t: NDArray[np.float64]
    channels: Mapping[str, NDArray[np.float64]]
    name: str = "log"
    sha256: str = ""
    warnings: tuple[str, ...] = field(default=())
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        """Freeze the arrays and refuse a clock that does not increase or channels of another length."""
        if not hasattr(self.channels, "items"):  # a table of pandas is no mapping
            require_kind(self.channels, Mapping, "set of channels", "a dictionary from column to values")
        t = _frozen(self.t, f"{self.name}: t")
        channels = {key: _frozen(value, f"{self.name}: {key}") for key, value in self.channels.items()}
        if t.ndim != 1 or t.size < 2:
            raise InputError("too_little_data", f"{self.name} has {count(t.size, 'sample')}; a log needs at least two.")
        if not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0.0):
            raise InputError("time_stamps", f"{self.name}: t must be finite and increase from sample to sample.")
        for key, value in channels.items():
            if value.shape != t.shape:
                raise InputError(
                    "wrong_shape", f"{self.name}: {key} has shape {value.shape} where t has {t.size} samples."
                )
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "channels", MappingProxyType(channels))
        object.__setattr__(self, "warnings", tuple(self.warnings))

    def __reduce__(self) -> tuple[Any, ...]:
        """Allow pickling of a log; a mapping proxy cannot be pickled."""
        return Log, (self.t, dict(self.channels), self.name, self.sha256, self.warnings, self.origin)

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return int(self.t.size)

    @cached_property
    def dt(self) -> float:
        """Time between samples [s]: the mean of the usual steps, those within half of their median.

        Lost samples do not affect it, and neither does rounding, unlike the median: at 1.7e9 s a clock has steps of 2.4e-7 s.
        """
        steps = np.diff(self.t)
        usual = steps[np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)]
        return float(np.mean(usual)) if usual.size else float(np.median(steps))

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz], the inverse of `dt`."""
        return 1.0 / self.dt

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    def joints(self, signal: str) -> tuple[str, ...]:
        """Return the joints that have a column `signal_J`, in the file's order."""
        return tuple(joint for kind, joint in map_joints(self.channels) if kind == signal)

    def has(self, signal: str, names: Iterable[str]) -> bool:
        """Return whether every joint named has a column of this signal."""
        return all(f"{signal}_{name}" in self.channels for name in names)

    def joint(self, signal: str, names: Iterable[str]) -> NDArray[np.float64]:
        """Return one signal of several joints.

        Args:
            signal: One of `column_names.SIGNALS`, such as `q`, `tau` or `q_ref`.
            names: Joints, in the order wanted for the columns.

        Returns:
            Samples (N, n), one column for each joint, in the log's SI units.

        Raises:
            InputError: A joint has no such column.
        """
        columns = [f"{signal}_{name}" for name in names]
        for column in columns:
            if column not in self.channels:
                raise InputError("missing_column", self.describe_missing(column))
        return np.column_stack([self.channels[c] for c in columns]) if columns else np.empty((self.n_samples, 0))

    def describe_missing(self, column: str) -> str:
        """Return the sentence about a column that the log lacks."""
        if column in self.origin.without_numbers:
            return (
                f"{self.name}: column {column} has no number in it, every cell is empty or nan; log it, or map another column "
                f"to {column}."
            )
        return describe_missing_column(self.name, column, ("t", *self.channels), more=_NAME_IT)

    def temperatures(self, names: Iterable[str]) -> NDArray[np.float64] | None:
        """Return the temperature at each of several joints (N, n) [degC]: their own, else the room's; None without either."""
        names = tuple(names)
        if self.has("temp", names):
            return self.joint("temp", names)
        room = self.channels.get(ROOM_TEMPERATURE)
        return None if room is None else np.repeat(room[:, None], len(names), axis=1)

    def split(self, fraction: float) -> tuple["Log", "Log"]:
        """Cut the log in two in time: the first `fraction` of its samples, and the rest.

        Raises:
            InputError: A part would hold fewer than two samples.
        """
        cut = int(np.floor(fraction * self.n_samples + 1e-9))
        if not 2 <= cut <= self.n_samples - 2:
            raise InputError(
                "invalid_value",
                f"{self.name}: {fraction:g} of {self.n_samples} samples leaves a part with less than two.",
            )
        return self.window(0, cut), self.window(cut, self.n_samples)

    def window(self, start: int, stop: int) -> "Log":
        """Return the samples `start` to `stop - 1`, counted as Python slices count."""
        return self._take(slice(start, stop))

    def select_time(self, t0: float, t1: float) -> "Log":
        """Return the samples with t0 <= t <= t1 [s]."""
        start, stop = np.searchsorted(self.t, t0, "left"), np.searchsorted(self.t, t1, "right")
        if stop - start < 2:
            raise InputError(
                "too_little_data",
                f"{self.name} has fewer than two samples from {t0:g} to {t1:g} s; "
                f"it runs from {self.t[0]:g} to {self.t[-1]:g} s.",
            )
        return self.window(int(start), int(stop))

    def __len__(self) -> int:
        """Return the number of samples."""
        return self.n_samples

    __iter__ = None  # neither a mapping nor a sequence: use `t` or `channels`

    @overload
    def __getitem__(self, key: str) -> NDArray[np.float64]: ...
    @overload
    def __getitem__(self, key: slice) -> "Log": ...
    def __getitem__(self, key: str | slice) -> "NDArray[np.float64] | Log":
        """Return a column (N,) by its name, or a part of the log: `log[100:200]` by samples, `log[10.0:20.0]` by time [s].

        Whole numbers count samples as Python's slices do. Floats are times, start <= t < stop, so that parts do not overlap;
        negative times count from the end, `log[-5.0:]`, unless the log's own clock starts below zero.

        Raises:
            InputError: There is no such column, the ends are of both kinds, or fewer than two samples are left.
        """
        if isinstance(key, slice):
            part = self._to_samples(key)
            if len(self.t[part]) < 2:
                runs = f"{self.n_samples} samples from {self.t[0]:.6g} to {self.t[-1]:.6g} s"
                few = f"this part has {len(self.t[part])} of {runs}; a part needs two or more"
                raise InputError("too_little_data", f"{self.name}: {few}")
            return self._take(part)
        if not isinstance(key, str):
            raise InputError(
                "invalid_value",
                f"{self.name}: log[{key!r}] is neither a column nor a part; write log['q_J'], log[100:200] or log[10.0:20.0]",
            )
        if key != "t" and key not in self.channels:
            raise InputError("missing_column", self.describe_missing(key))
        return self.t if key == "t" else self.channels[key]

    def _to_samples(self, key: slice) -> slice:
        """Return a slice of samples from a slice of samples or of times."""
        ends = [x for x in (key.start, key.stop) if x is not None]
        times = [isinstance(x, float | np.floating) for x in ends]
        if not any(times):
            return key
        if not all(times) or key.step is not None:
            raise InputError(
                "invalid_value",
                f"{self.name}: log[{key.start}:{key.stop}] mixes samples and times; write log[10.0:20.0]",
            )
        end = self.t[-1] if self.t[0] >= 0 else 0.0
        ends = [x if x is None or x >= 0 else end + x for x in (key.start, key.stop)]
        start, stop = (None if x is None else int(np.searchsorted(self.t, x)) for x in ends)
        return slice(start, stop)

    def _take(self, part: slice) -> "Log":
        return replace(self, t=self.t[part], channels={key: value[part] for key, value in self.channels.items()})

    def with_channels(self, **channels: ArrayLike) -> "Log":
        """Return the same log with channels (N,) added or replaced."""
        return replace(self, channels={**self.channels, **channels})

    def with_warnings(self, *warnings: str) -> "Log":
        """Return the same log with further warning sentences, each once."""
        return replace(self, warnings=tuple(dict.fromkeys((*self.warnings, *warnings))))

    def to_frame(self) -> "pd.DataFrame":
        """Return the log as a table with `t` first, one row for each sample."""
        import pandas as pd

        return pd.DataFrame({"t": self.t, **self.channels})

    def to_csv(self, path: str | Path) -> None:
        """Write the log as CSV with 12 significant digits; the file is written completely or not at all.

        Raises:
            InputError: The folder does not exist or cannot be written.
        """
        with write_atomically(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("t", *self.channels))
            columns = [self.t, *self.channels.values()]
            for start in range(0, self.n_samples, _ROWS_AT_ONCE):
                rows = np.column_stack([x[start : start + _ROWS_AT_ONCE] for x in columns])
                text = (",".join(["%.12g"] * len(columns)) + "\n") * len(rows) % tuple(rows.ravel().tolist())
                file.write(text if np.isfinite(rows).all() else re.sub(r"\bnan\b", "", text))


def _frozen(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return the values as read-only float64, copied only if they could still be written to."""
    array = as_numbers(values, name)
    if array.flags.writeable or array.base is not None and getattr(array.base, "flags", array.flags).writeable:
        array = array.copy()
    array.setflags(write=False)
    return array
