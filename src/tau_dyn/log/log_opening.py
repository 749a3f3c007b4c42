"""How a recording is opened: in memory where it is small, else to be read in windows (`recording.py`).

Parquet files, one or many, may together exceed memory. Text larger than `MAX_IN_MEMORY_BYTES`, and Parquet in row groups
larger than
`GROUP_ROWS`, is first copied (`copies.py`), as neither lets anybody begin in the middle.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tau_dyn.exceptions import InputError
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.containers import has_topics
from tau_dyn.log.copies import copy_groups, copy_text
from tau_dyn.log.log import Log
from tau_dyn.log.read import read_log, refuse_few
from tau_dyn.log.recording import Recording, RowGroup, State, get_file_state, open_parquet_file
from tau_dyn.log.table import PARQUET_SUFFIXES

MAX_IN_MEMORY_SAMPLES = 2**18
"""Samples up to which a file is read at once."""

MAX_IN_MEMORY_BYTES = 2**26
"""Size of a text file up to which it is read at once."""

GROUP_ROWS = 2**20
"""Rows of a row group up to which it is decoded at once."""


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
        if recording.n_samples <= MAX_IN_MEMORY_SAMPLES:
            return read_log(path, map_)
    elif path.is_file() and path.stat().st_size > MAX_IN_MEMORY_BYTES:
        recording = _copied_text(path, map_)
    else:
        return read_log(path, map_)
    refuse_few(path.name, recording.n_samples)
    return recording.whole() if recording.n_samples <= MAX_IN_MEMORY_SAMPLES else recording


def _files_in(folder: Path) -> tuple[Path, ...]:
    found = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in PARQUET_SUFFIXES and p.is_file()))
    if not found:
        raise InputError(
            "file_not_found", f"{folder} has no Parquet file in it; give a log, or a folder of .parquet files."
        )
    return found


def _opened(name: str, paths: tuple[Path, ...], map_: ColumnMap | None) -> Recording:
    """Read what the files say of themselves."""
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
                f"{has} has a column {odd} and {lacks} has none; the files of one recording need the same columns.",
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
