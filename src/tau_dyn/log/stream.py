"""A recording that is read in windows instead of at once: Parquet files, one or many, that together may exceed memory.

Rows are numbered through all files. A window decodes only the row groups and columns it needs, checks every cell as
`read.py` does, and comes as a `Log`. Text larger than `TEXT_BYTES`, and Parquet in row groups larger than `GROUP_ROWS`, is first
copied to Parquet in a temporary folder, as neither lets anybody begin in the middle.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.exceptions import InputError
from tau_dyn.files import owner, sweep
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.containers import has_topics
from tau_dyn.log.log import Log
from tau_dyn.log.names import listed, used_columns
from tau_dyn.log.read import MIN_SAMPLES, read_log
from tau_dyn.log.table import PARQUET_SUFFIXES, Table, parquet_cells
from tau_dyn.log.text_chunks import text_chunks

LARGE = 2**18
"""Samples up to which a file is read at once."""

TEXT_BYTES = 2**26
"""Size of a text file up to which it is read at once."""

GROUP_ROWS = 2**20
"""Rows of a row group up to which it is decoded at once."""


State = tuple[int, int]
"""What changes when a file is written: its size and the time of its last change [ns]."""


class Part(NamedTuple):
    """One row group: its file and state, number, first row in the recording and in the file (from 0), and how many."""

    path: str
    state: State
    group: int
    first: int
    in_file: int
    rows: int


class TemporaryFolder:
    """A folder that is gone when nobody uses it any more."""

    def __init__(self) -> None:
        """Make it where the system keeps temporary files (`TMPDIR`); those of killed processes go."""
        sweep(Path(tempfile.gettempdir()), "tau_dyn_")
        self.path = Path(tempfile.mkdtemp(prefix=f"tau_dyn_{owner()}.", suffix=".part"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


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
    parts: tuple[Part, ...]
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
            if not path.is_file() or _state(path) != state:
                raise InputError(
                    f"{path.name} was written to while it was read; let the recording end, or copy it first"
                )
        digests = [_sha256(str(path), state) for path, state in zip(self.paths, self.states, strict=True)]
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def has(self, name: str) -> bool:
        """Tell whether there is a channel of this name."""
        return name in (self.columns if self.map_ is None else (*self.map_.sources, *self.columns))

    def clock(self) -> Iterator[tuple[Part, np.ndarray]]:
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
        names = self.columns if self.map_ is None else (*self.map_.sources, *self.columns)
        log = self.window(0, self.n_samples, [n for n in dict.fromkeys(names) if n != "t"])
        return replace(log, sha256=self.sha256)

    def _channel(self, part: Part, name: str) -> np.ndarray:
        """Return one channel (rows,) of a part in SI units."""
        if self.map_ is None or (name not in self.map_.sources and not (name == "t" and self.map_.rate_hz)):
            if name not in self.columns:
                raise InputError(
                    f"{Path(part.path).name} has no column {name}; it has {listed(self.columns)}; name the clock t [s], or "
                    "give a column map (with t: {rate_hz: F} if there is no clock)."
                )
            return _cells(part, name)
        if name == "t" and self.map_.rate_hz:
            return (part.first + np.arange(part.rows)) / self.map_.rate_hz
        signal, _, joint = name.partition("_")
        coupling = self.map_.couplings.get(signal)
        if coupling is None or joint not in coupling.joints:
            return self._theirs(part, name)
        names = [f"{signal}_{other}" for other in coupling.joints]
        mixed = coupling.apply(np.column_stack([self._theirs(part, other) for other in names]))
        return mixed[:, names.index(name)]

    def _theirs(self, part: Part, ours: str) -> np.ndarray:
        source = self.map_.sources[ours]  # type: ignore[union-attr]
        if source.column not in self.columns:
            raise InputError(
                f"{self.name} has no column {source.column}, which {self.map_.name} takes for {ours}; "  # type: ignore[union-attr]
                f"it has {listed(self.columns)}."
            )
        return source.scale * _cells(part, source.column) + source.offset


def open_log(path: str | Path, columns: ColumnMap | str | Path | None = None) -> Log | Recording:
    """Open a recording: in memory where it is small, else to be read in windows.

    Args:
        path: CSV, Parquet, or a folder of Parquet files that follow each other in time, in the order of their names.
        columns: Map for a foreign log, or the path of one.

    Raises:
        InputError: It cannot be used; the message names file, row and column.
    """
    path = Path(path)
    map_ = columns if columns is None or isinstance(columns, ColumnMap) else ColumnMap.load(columns)
    if map_ is not None and map_.files or has_topics(path):
        return read_log(path, map_)
    if path.is_dir():
        recording = _opened(path.name, _files_in(path), map_)
    elif path.suffix.lower() in PARQUET_SUFFIXES and path.is_file() and path.stat().st_size:
        recording = _opened(path.name, (path,), map_)
        if recording.n_samples <= LARGE:
            return read_log(path, map_)
    elif path.is_file() and path.stat().st_size > TEXT_BYTES:
        recording = _copied_text(path, map_)
    else:
        return read_log(path, map_)
    if recording.n_samples < MIN_SAMPLES:
        raise InputError(
            f"{path.name} has {recording.n_samples} sample(s); a log needs at least {MIN_SAMPLES} to say anything."
        )
    return recording.whole() if recording.n_samples <= LARGE else recording


def _files_in(folder: Path) -> tuple[Path, ...]:
    found = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in PARQUET_SUFFIXES and p.is_file()))
    if not found:
        raise InputError(f"{folder} has no Parquet file in it; give a log, or a folder of .parquet files.")
    return found


def _opened(name: str, paths: tuple[Path, ...], map_: ColumnMap | None) -> Recording:
    """Read what the files say of themselves."""
    parts, first, columns, states = [], 0, (), tuple(_state(path) for path in paths)
    for path, state in zip(paths, states, strict=True):
        file = _parquet(str(path), state)
        theirs = tuple(file.schema_arrow.names)
        if len(set(theirs)) < len(theirs):
            twice = next(c for c in theirs if theirs.count(c) > 1)
            raise InputError(f"{path.name} names column {twice} twice; every column needs a name of its own.")
        columns = columns or theirs
        if set(theirs) != set(columns):
            odd = min(set(theirs) ^ set(columns))
            has, lacks = (path.name, paths[0].name) if odd in theirs else (paths[0].name, path.name)
            raise InputError(
                f"{has} has a column {odd} and {lacks} has none; the files of one recording need the same columns."
            )
        in_file = 0
        for group in range(file.metadata.num_row_groups):
            rows = file.metadata.row_group(group).num_rows
            if rows:
                parts.append(Part(str(path), state, group, first, in_file, rows))
            first, in_file = first + rows, in_file + rows
    if not parts:
        raise InputError(f"{name} has columns but no rows; a log needs one row a sample.")
    if any(part.rows > GROUP_ROWS for part in parts):
        return _copied_groups(name, paths, states, map_)
    return Recording(name, paths, tuple(parts), columns, map_, states=states)


def _state(path: Path) -> State:
    about = path.stat()
    return about.st_size, about.st_mtime_ns


@lru_cache(maxsize=16)
def _parquet(path: str, state: State) -> pq.ParquetFile:
    """Open a file; one that was written to since is another one."""
    try:
        file = pq.ParquetFile(path)
        file.schema_arrow.names  # noqa: B018  a name that is no UTF-8 is found here
        return file
    except (pa.ArrowException, OSError, ValueError):
        raise InputError(f"{Path(path).name} is not a Parquet file; give CSV another suffix than .parquet.") from None


@lru_cache(maxsize=32)
def _cells(part: Part, column: str) -> np.ndarray:
    """Return one column of a row group as checked numbers (rows,); the last few are kept, as windows overlap."""
    try:
        cells = _parquet(part.path, part.state).read_row_group(part.group, columns=[column]).column(column)
    except (pa.ArrowException, OSError) as fault:
        raise InputError(f"{Path(part.path).name} is damaged: {str(fault).splitlines()[0]}") from None
    places = np.arange(part.in_file + 1, part.in_file + part.rows + 1)
    table = Table(
        Path(part.path).name,
        Path(part.path),
        "",
        {column: parquet_cells(Path(part.path).name, column, cells)},
        places,
        "row",
    )
    values = None if used_columns((column,)) else table.numbers_or_none(column)
    values = table.numbers(column) if values is None else values
    values.setflags(write=False)
    return values


def _refuse_backwards(part: Part, t: np.ndarray, row: int, before: float, where: str) -> None:
    name = Path(part.path).name
    if row == 0 and where and where != part.path:
        raise InputError(
            f"{name} begins at t = {t[0]:.9g} s, and {Path(where).name} before it ends at {before:.9g} s; the files of one "
            "recording must follow each other in time. Several recordings? Give the files one by one."
        )
    last = before if row == 0 else t[row - 1]
    what = f"t = {t[row]:.9g} s stands twice" if t[row] == last else f"t = {t[row]:.9g} s comes after {last:.9g} s"
    raise InputError(f"{name}, row {part.in_file + row + 1}: {what}; every sample needs a later time.")


def _copied_text(path: Path, map_: ColumnMap | None) -> Recording:
    """Copy a large text file to Parquet, piece by piece, every cell checked where it stands."""
    folder, digest = TemporaryFolder(), hashlib.sha256()
    target, warnings, writer = folder.path / f"{path.stem}.parquet", [], None
    theirs = {source.column for source in map_.sources.values()} if map_ is not None else set()
    with _room_for_a_copy(path.name, folder):
        for table in text_chunks(path, digest):
            used = theirs | set(used_columns(tuple(table.cells)))
            numbers = {c: table.numbers(c) for c in table.cells if c in used}
            warnings += table.warnings
            writer = writer or pq.ParquetWriter(target, pa.table(numbers).schema, compression="snappy")
            writer.write_table(pa.table(numbers), row_group_size=2**17)
        if writer is None:
            raise InputError(f"{path.name} has no rows; a log needs one line a sample.")
        writer.close()
    recording = _opened(path.name, (target,), map_)
    said = tuple(warnings)
    return replace(recording, name=path.name, paths=(path,), warnings=said, digest=digest.hexdigest(), copied=folder)


def _copied_groups(name: str, paths: tuple[Path, ...], states: tuple[State, ...], map_: ColumnMap | None) -> Recording:
    """Copy Parquet files whose row groups are too large to row groups that are not."""
    folder = TemporaryFolder()
    copies = []
    with _room_for_a_copy(name, folder):
        for number, (path, state) in enumerate(zip(paths, states, strict=True)):
            file, target = _parquet(str(path), state), folder.path / f"{number:06d}_{path.name}"
            with pq.ParquetWriter(target, file.schema_arrow, compression="snappy") as writer:
                for batch in file.iter_batches(batch_size=min(2**17, GROUP_ROWS)):
                    writer.write_batch(batch)
            copies.append(target)
    return replace(_opened(name, tuple(copies), map_), paths=paths, states=states, copied=folder)


@contextmanager
def _room_for_a_copy(name: str, folder: TemporaryFolder) -> Iterator[None]:
    """Say where the room is missing when a copy does not fit."""
    try:
        yield
    except OSError as fault:
        raise InputError(
            f"{name} is too large to be read at once, and its copy in {folder.path.parent} failed ({fault.strerror or fault}); "
            "free some space there, or name another folder in TMPDIR"
        ) from fault


@lru_cache(maxsize=4096)
def _sha256(path: str, state: State) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
