"""A recording on disk: its files' row groups one after another, its channels converted and checked as they are read.

Rows are numbered through all files. A window decodes only the row groups and columns it needs, checks every cell as
`read.py` does, and comes as a `Log`. How one is opened stands in `log_opening.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_joint_sha256, compute_sha256
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import list_used_columns, split_column_name
from tau_dyn.log.copies import TemporaryFolder
from tau_dyn.log.log import Log
from tau_dyn.log.read_errors import describe_missing_clock, describe_missing_column
from tau_dyn.log.table import Table, read_parquet_column

State = tuple[int, int]
"""What changes when a file is written: its size and the time of its last change [ns]."""


class RowGroup(NamedTuple):
    """One row group: its file and state, number, first row in the recording and in the file (from 0), and how many."""

    path: str
    state: State
    group: int
    first: int
    in_file: int
    rows: int


@dataclass(frozen=True, eq=False)
class Recording:
    """A log on disk.

    Attributes:
        name: For messages.
        paths: Its files, in order of time.
        parts: Their row groups.
        columns: The files' columns.
        map_: How foreign columns are read; None for our own names.
        warnings: What was doubtful on the way in.
        states: The files' states when they were opened.
        digest: Hash of what was read, where that is known already.
        copied: Keeps a temporary copy alive.
    """

    name: str
    paths: tuple[Path, ...]
    parts: tuple[RowGroup, ...]
    columns: tuple[str, ...]
    map_: ColumnMap | None = None
    warnings: tuple[str, ...] = ()
    states: tuple[State, ...] = ()
    digest: str = ""
    copied: TemporaryFolder | None = field(default=None, repr=False)

    def __getstate__(self) -> dict:
        """Let it travel between processes; the copy stays alive where it was made."""
        return {**self.__dict__, "copied": None}

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return self.parts[-1].first + self.parts[-1].rows

    @property
    def sha256(self) -> str:
        """Hash of the files' bytes; of several, the hash of their hashes.

        Raises:
            InputError: A file was written to since it was opened, so nobody knows what was read.
        """
        if self.digest:
            return self.digest
        for path, state in zip(self.paths, self.states, strict=True):
            if not path.is_file() or get_file_state(path) != state:
                raise InputError(
                    "damaged_file",
                    f"{path.name} was written to while it was read; let the recording end, or copy it first",
                )
        return compute_joint_sha256(
            _sha256(str(path), state) for path, state in zip(self.paths, self.states, strict=True)
        )

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of its channels: those that a map makes, and the files' columns of which it makes none."""
        if self.map_ is None:
            return self.columns
        taken = {source.column for source in self.map_.sources.values()}
        return tuple(dict.fromkeys((*self.map_.sources, *(c for c in self.columns if c not in taken))))

    def has(self, name: str) -> bool:
        """Tell whether there is a channel of this name."""
        return name in self.channels

    def clock(self) -> Iterator[tuple[RowGroup, np.ndarray]]:
        """Yield the times [s] of each part in order, checked to run forward.

        Raises:
            InputError: A time is no number, or not later than the one before.
        """
        before, where = -np.inf, ""
        for part in self.parts:
            t = self._channel(part, "t")
            steps = np.diff(t, prepend=before)
            if not np.all(steps > 0):
                _refuse_backwards(part, t, int(np.argmin(steps > 0)), before, where)
            before, where = float(t[-1]), part.path
            yield part, t

    def window(self, start: int, stop: int, wanted: Iterable[str]) -> Log:
        """Return the samples `start` to `stop - 1` with those of the wanted channels that exist."""
        inside = [p for p in self.parts if p.first < stop and p.first + p.rows > start]
        found: dict[str, np.ndarray] = {}
        for name in ("t", *(n for n in wanted if self.has(n))):
            pieces = [self._channel(p, name)[max(0, start - p.first) : stop - p.first] for p in inside]
            found[name] = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
        return Log(found.pop("t"), found, self.name, "", self.warnings)

    def whole(self) -> Log:
        """Return everything as a log in memory, foreign columns and all."""
        log = self.window(0, self.n_samples, [n for n in self.channels if n != "t"])
        return replace(log, sha256=self.sha256)

    @cached_property
    def _used(self) -> frozenset[str]:
        """Channels whose every cell has to be a number."""
        return frozenset(list_used_columns(self.channels))

    def _channel(self, part: RowGroup, name: str) -> np.ndarray:
        """Return one channel (rows,) of a part in SI units."""
        if self.map_ is None or (name not in self.map_.sources and not (name == "t" and self.map_.rate_hz)):
            if name not in self.columns:
                file, columns = Path(part.path).name, tuple(self.columns)
                raise InputError(
                    "missing_column",
                    describe_missing_clock(file, columns)
                    if name == "t"
                    else describe_missing_column(file, name, columns),
                )
            return _cells(part, name, name in self._used)
        if name == "t" and self.map_.rate_hz:
            return (part.first + np.arange(part.rows)) / self.map_.rate_hz
        signal, joint = split_column_name(name) or ("", "")
        coupling = self.map_.couplings.get(signal)
        if coupling is None or joint not in coupling.joints:
            return self._theirs(part, name)
        names = [f"{signal}_{other}" for other in coupling.joints]
        mixed = coupling.apply(np.column_stack([self._theirs(part, other) for other in names]))
        return mixed[:, names.index(name)]

    def _theirs(self, part: RowGroup, ours: str) -> np.ndarray:
        source = self.map_.sources[ours]  # type: ignore[union-attr]
        if source.column not in self.columns:
            wanted = f", which {self.map_.name} takes for {ours}"  # type: ignore[union-attr]
            raise InputError(
                "missing_column", describe_missing_column(self.name, source.column, tuple(self.columns), wanted)
            )
        return source.scale * _cells(part, source.column, True, source.scale) + source.offset


def get_file_state(path: Path) -> State:
    """Return a file's state now."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns


@lru_cache(maxsize=16)
def open_parquet_file(path: str, state: State) -> pq.ParquetFile:
    """Open a file; one that was written to since is another one."""
    try:
        file = pq.ParquetFile(path)
        file.schema_arrow.names  # noqa: B018  a name that is no UTF-8 is found here
        return file
    except (pa.ArrowException, OSError, ValueError):
        raise InputError(
            "file_format", f"{Path(path).name} is not a Parquet file; give CSV another suffix than .parquet."
        ) from None


@lru_cache(maxsize=32)
def _cells(part: RowGroup, column: str, checked: bool, scale: float = 1.0) -> np.ndarray:
    """Return one column of a row group as numbers (rows,), which may be missing unless it is checked (once scaled).

    The last few are kept, as windows overlap.
    """
    try:
        cells = open_parquet_file(part.path, part.state).read_row_group(part.group, columns=[column]).column(column)
    except (pa.ArrowException, OSError) as fault:
        raise InputError("damaged_file", f"{Path(part.path).name} is damaged: {str(fault).splitlines()[0]}") from None
    path, places = Path(part.path), np.arange(part.in_file + 1, part.in_file + part.rows + 1)
    table = Table(path.name, path, "", {column: read_parquet_column(path.name, column, cells)}, places, "row")
    values = None if checked else table.numbers_or_none(column)
    values = table.numbers(column, scale) if values is None else values
    values.setflags(write=False)
    return values


def _refuse_backwards(part: RowGroup, t: np.ndarray, row: int, before: float, where: str) -> None:
    name = Path(part.path).name
    if row == 0 and where and where != part.path:
        raise InputError(
            "time_stamps",
            f"{name} begins at t = {t[0]:.9g} s, and {Path(where).name} before it ends at {before:.9g} s; the files of one "
            "recording must follow each other in time. Several recordings? Give the files one by one.",
        )
    last = before if row == 0 else t[row - 1]
    what = f"t = {t[row]:.9g} s stands twice" if t[row] == last else f"t = {t[row]:.9g} s comes after {last:.9g} s"
    raise InputError("time_stamps", f"{name}, row {part.in_file + row + 1}: {what}; every sample needs a later time.")


@lru_cache(maxsize=4096)
def _sha256(path: str, state: State) -> str:
    """Return a file's hash; one that was written to since is another one."""
    return compute_sha256(path)
