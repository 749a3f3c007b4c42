"""A recording on disk: its files' row groups in sequence; channels are converted and checked as they are read.

Rows are numbered through all files. A window decodes only the row groups and columns it needs, checks every cell as `read.py`
does, and comes as a `Log`. `open_log` reads a small file at once. Parquet files, one or many, may together exceed memory; text
larger than `MAX_IN_MEMORY_BYTES`, and Parquet in row groups larger than `GROUP_ROWS`, is first copied (`copies.py`), as
neither can be read from the middle.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias, overload, runtime_checkable

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.exceptions import InputError, require_kind
from tau_dyn.files import compute_joint_sha256, compute_sha256
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import (
    describe_missing_clock,
    describe_missing_column,
    list_used_columns,
    split_column_name,
)
from tau_dyn.log.copies import TemporaryFolder, copy_groups, copy_text
from tau_dyn.log.log import Log
from tau_dyn.log.read import has_topics, read_log, refuse_few
from tau_dyn.log.table import PARQUET_SUFFIXES, Table, read_parquet_column

State = tuple[int, int]
"""State of a file: its size and the time of its last change [ns]."""


class RowGroup(NamedTuple):
    """One row group: its file and state, number, first row in the recording and in the file (from 0), and number of rows."""

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
        name: Name for messages.
        paths: Its files, in order of time.
        parts: Their row groups.
        columns: The files' columns.
        map_: Column map of foreign columns; None for our own names.
        warnings: Doubts found while reading, one sentence each.
        states: The files' states when they were opened.
        digest: Hash of the bytes read, if known already.
        copied: Temporary copy, kept while the recording is used.
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

    def __getstate__(self) -> dict[str, Any]:
        """Allow pickling; the copy is kept by the process that made it."""
        return {**self.__dict__, "copied": None}

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return self.parts[-1].first + self.parts[-1].rows

    @property
    def sha256(self) -> str:
        """Hash of the file's bytes; for several files, the hash of their hashes.

        Raises:
            InputError: A file was written to since it was opened, so its hash may not belong to the data read.
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
        """Names of its channels: those that a map defines, and the files' columns that it does not use."""
        if self.map_ is None:
            return self.columns
        taken = {source.column for source in self.map_.sources.values()}
        return tuple(dict.fromkeys((*self.map_.sources, *(c for c in self.columns if c not in taken))))

    def has(self, name: str) -> bool:
        """Return whether there is a channel of this name."""
        return name in self.channels

    def clock(self) -> Iterator[tuple[RowGroup, np.ndarray]]:
        """Yield the times [s] of each part in order, checked to increase.

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
        """Return everything as a log in memory, with foreign columns."""
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
    """Open a file; a file that was written to since counts as another one."""
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

    The last few results are cached, as windows overlap.
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
    what = f"t = {t[row]:.9g} s occurs twice" if t[row] == last else f"t = {t[row]:.9g} s comes after {last:.9g} s"
    raise InputError("time_stamps", f"{name}, row {part.in_file + row + 1}: {what}; every sample needs a later time.")


@lru_cache(maxsize=4096)
def _sha256(path: str, state: State) -> str:
    """Return a file's hash; a file that was written to since counts as another one."""
    return compute_sha256(path)


MAX_IN_MEMORY_SAMPLES = 2**18
"""Samples up to which a file is read at once."""

MAX_IN_MEMORY_BYTES = 2**26
"""Size of a text file up to which it is read at once."""

GROUP_ROWS = 2**20
"""Rows of a row group up to which it is decoded at once."""


def open_log(path: str | Path, columns: ColumnMap | str | Path | None = None) -> Log | Recording:
    """Open a recording: in memory if it is small, else to be read in windows.

    Args:
        path: CSV, Parquet, or a folder of Parquet files that follow each other in time, in the order of their names.
        columns: Map for a foreign log, or the path of one.

    Raises:
        InputError: It cannot be used; the message names file, row and column.
    """
    path = Path(path)
    map_ = columns if columns is None or isinstance(columns, ColumnMap) else ColumnMap.load(columns)
    if map_ is not None and (map_.files or _needs_the_whole(map_)) or has_topics(path):
        return read_log(path, map_)
    if path.is_dir():
        recording = _opened(path.name, _files_in(path), map_)
    elif path.suffix.lower() in PARQUET_SUFFIXES and path.is_file() and path.stat().st_size:
        recording = _opened(path.name, (path,), map_)
        if recording.n_samples <= MAX_IN_MEMORY_SAMPLES:
            return read_log(path, map_)
    elif path.is_file() and path.stat().st_size > MAX_IN_MEMORY_BYTES:
        recording = _copied_text(path, map_)
    else:
        return read_log(path, map_)
    refuse_few(path.name, recording.n_samples)
    return recording.whole() if recording.n_samples <= MAX_IN_MEMORY_SAMPLES else recording


def _needs_the_whole(map_: ColumnMap) -> bool:
    """Return whether a map needs features that windows lack: an episode, columns by number, parts of lists."""
    parts = any(source.column.endswith("]") for source in map_.sources.values())
    return map_.episode is not None or map_.is_numbered or parts


def _files_in(folder: Path) -> tuple[Path, ...]:
    found = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in PARQUET_SUFFIXES and p.is_file()))
    if not found:
        raise InputError(
            "file_not_found",
            f"{folder} has no Parquet file in it; give its logs one by one, or a folder of .parquet files. If its files are one "
            "recording, `tau-dyn columns FOLDER ROBOT` proposes a map that joins them.",
        )
    return found


def _opened(name: str, paths: tuple[Path, ...], map_: ColumnMap | None) -> Recording:
    """Open the files and read their schema and row groups."""
    parts, first, columns, states = [], 0, (), tuple(get_file_state(path) for path in paths)
    for path, state in zip(paths, states, strict=True):
        file = open_parquet_file(str(path), state)
        theirs = tuple(file.schema_arrow.names)
        if len(set(theirs)) < len(theirs):
            twice = next(c for c in theirs if theirs.count(c) > 1)
            raise InputError(
                "duplicate_name", f"{path.name} names column {twice} twice; every column needs a name of its own."
            )
        columns = columns or theirs
        if set(theirs) != set(columns):
            odd = min(set(theirs) ^ set(columns))
            has, lacks = (path.name, paths[0].name) if odd in theirs else (paths[0].name, path.name)
            raise InputError(
                "missing_column",
                f"{has} has a column {odd} and {lacks} has no such column; the files of one recording need the same columns.",
            )
        in_file = 0
        for group in range(file.metadata.num_row_groups):
            rows = file.metadata.row_group(group).num_rows
            if rows:
                parts.append(RowGroup(str(path), state, group, first, in_file, rows))
            first, in_file = first + rows, in_file + rows
    if not parts:
        raise InputError("too_little_data", f"{name} has columns but no rows; a log needs one row a sample.")
    if any(part.rows > GROUP_ROWS for part in parts):
        return _copied_groups(name, paths, states, map_)
    return Recording(name, paths, tuple(parts), columns, map_, states=states)


def _copied_text(path: Path, map_: ColumnMap | None) -> Recording:
    """Return a large text file as a recording of its copy."""
    copy = copy_text(path, map_)
    recording = _opened(path.name, copy.paths, map_)
    columns = tuple(column for column in recording.columns if column not in copy.texts)
    found = replace(recording, paths=(path,), columns=columns, warnings=copy.warnings, digest=copy.digest)
    return replace(found, copied=copy.folder)


def _copied_groups(name: str, paths: tuple[Path, ...], states: tuple[State, ...], map_: ColumnMap | None) -> Recording:
    """Return Parquet files whose row groups are too large as a recording of their copy."""
    files = ((path, open_parquet_file(str(path), state)) for path, state in zip(paths, states, strict=True))
    copy = copy_groups(name, files, GROUP_ROWS)
    return replace(_opened(name, copy.paths, map_), paths=paths, states=states, copied=copy.folder)


@runtime_checkable
class DataTable(Protocol):
    """Interface of a pandas table that this module uses."""

    columns: Any
    index: Any

    def reset_index(self) -> Any:
        """Return the table with its index as a column."""
        ...

    def __getitem__(self, name: Any) -> Any:
        """Return a column."""
        ...


LogSource: TypeAlias = Log | str | Path | DataTable
"""A log, the path of its file, or a table with a column for each channel."""


@overload
def as_log(source: Recording) -> Recording: ...
@overload
def as_log(source: LogSource) -> Log: ...
@overload
def as_log(source: LogSource | Recording) -> Log | Recording: ...
def as_log(source: LogSource | Recording) -> Log | Recording:
    """Return a log unchanged, or read a path's file or a table's columns as a log.

    Args:
        source: A log or a recording on disk; a path, read by `read_log`; or a table with `t` [s], as a column or as the name of
            its index, and channels by name, such as `q_J` and `tau_J`.

    Raises:
        InputError: It is something else, the file cannot be read, or a column of the table holds no numbers.
    """
    if isinstance(source, Log | Recording):
        return source
    if isinstance(source, str | Path):
        return read_log(source)
    require_kind(source, DataTable, "log", "a Log, the path of its file, or a pandas table with t, q_J and tau_J")
    table = source.reset_index() if source.index.name == "t" and "t" not in source.columns else source
    if "t" not in table.columns:
        listed = ", ".join(map(str, list(table.columns)[:12]))
        raise InputError(
            "missing_column",
            f"the table has no column t [s]; it has {listed}. Name its columns t, q_J and tau_J, in SI units",
        )
    channels = {str(name): _read_column(table, name) for name in table.columns}
    return Log(channels.pop("t"), channels, "table")


def as_logs(logs: LogSource | Iterable[LogSource]) -> list[Log]:
    """Return one log or many as a list; see `as_log`."""
    if isinstance(logs, Log | str | Path | DataTable) or not isinstance(logs, Iterable):
        return [as_log(logs)]
    return [as_log(one) for one in logs]


def _read_column(table: DataTable, name: Any) -> np.ndarray:
    """Return a column as numbers (N,).

    Raises:
        InputError: A cell is no number.
    """
    try:
        return np.array(table[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("bad_sample", f"column {name} of the table holds cells that are no numbers") from None
