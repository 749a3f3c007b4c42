"""A copy that can be read from the middle: text, or Parquet in row groups too large for memory, as Parquet in a temporary folder.

It is written piece by piece, every cell of text checked where it stands, and gone when nobody uses it any more.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.exceptions import InputError
from tau_dyn.files import get_owner_name, remove_stale_files
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import list_used_columns
from tau_dyn.log.text_chunks import iterate_text_chunks

_ROWS = 2**17
"""Rows of a row group of a copy."""


class TemporaryFolder:
    """A folder that is gone when nobody uses it any more."""

    def __init__(self) -> None:
        """Make it where the system keeps temporary files (`TMPDIR`); those of killed processes go."""
        remove_stale_files(Path(tempfile.gettempdir()), "tau_dyn_")
        self.path = Path(tempfile.mkdtemp(prefix=f"tau_dyn_{get_owner_name()}.", suffix=".part"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class Copy(NamedTuple):
    """A copy of one or several files.

    Attributes:
        paths: Its files.
        folder: Where they live.
        digest: Hash of what was copied, where it is known.
        warnings: What was left out while reading.
        texts: Columns that hold text somewhere, which nobody can use.
    """

    paths: tuple[Path, ...]
    folder: TemporaryFolder
    digest: str = ""
    warnings: tuple[str, ...] = ()
    texts: frozenset[str] = frozenset()


def copy_text(path: Path, map_: ColumnMap | None) -> Copy:
    """Copy a large text file: its columns of ours (under their own names or by a map) checked, foreign ones if they are numbers.

    Raises:
        InputError: A line or a cell is at fault, or the copy does not fit on the disk.
    """
    folder, digest = TemporaryFolder(), hashlib.sha256()
    target, warnings, writer = folder.path / f"{path.stem}.parquet", [], None
    ours = tuple(map_.sources) if map_ is not None else ()
    theirs = {source.column: source.scale for source in map_.sources.values()} if map_ is not None else {}
    texts: set[str] = set()
    with _room_for_a_copy(path.name, folder):
        for table in iterate_text_chunks(path, digest):
            used = {*theirs, *list_used_columns((*ours, *table.cells))}
            columns = {
                c: table.numbers(c, theirs.get(c, 1.0)) if c in used else table.numbers_or_none(c) for c in table.cells
            }
            texts |= {c for c, values in columns.items() if values is None}
            warnings += table.warnings
            if writer is None:
                writer = pq.ParquetWriter(target, _schema(columns), compression="snappy")
            none = np.full(table.n_rows, np.nan)
            kept = {c: none if columns[c] is None else columns[c] for c in writer.schema.names}
            writer.write_table(pa.table(kept, writer.schema), row_group_size=_ROWS)
        if writer is None:
            raise InputError("too_little_data", f"{path.name} has no rows; a log needs one line a sample.")
        writer.close()
    return Copy((target,), folder, digest.hexdigest(), tuple(warnings), frozenset(texts))


def _schema(columns: Mapping[str, np.ndarray | None]) -> pa.Schema:
    """Return the columns of a copy: those that hold numbers in the first piece."""
    return pa.schema([(name, pa.float64()) for name, values in columns.items() if values is not None])


def copy_groups(name: str, files: Iterable[tuple[Path, pq.ParquetFile]], most_rows: int) -> Copy:
    """Copy Parquet files whose row groups are too large to files whose row groups have at most so many rows.

    Raises:
        InputError: A file is damaged, or the copy does not fit on the disk.
    """
    folder = TemporaryFolder()
    copies = []
    with _room_for_a_copy(name, folder):
        for number, (path, file) in enumerate(files):
            target = folder.path / f"{number:06d}_{path.name}"
            with pq.ParquetWriter(target, file.schema_arrow, compression="snappy") as writer:
                for batch in _batches(path, file, min(_ROWS, most_rows)):
                    writer.write_batch(batch)
            copies.append(target)
    return Copy(tuple(copies), folder)


def _batches(path: Path, file: pq.ParquetFile, rows: int) -> Iterator[pa.RecordBatch]:
    """Yield a file's rows, so many at a time."""
    try:
        yield from file.iter_batches(batch_size=rows)
    except (pa.ArrowException, OSError) as fault:
        raise InputError("damaged_file", f"{path.name} is damaged: {str(fault).splitlines()[0]}") from None


@contextmanager
def _room_for_a_copy(name: str, folder: TemporaryFolder) -> Iterator[None]:
    """Say where the room is missing when a copy does not fit."""
    try:
        yield
    except OSError as fault:
        raise InputError(
            "file_too_large",
            f"{name} is too large to be read at once, and its copy in {folder.path.parent} failed ({fault.strerror or fault}); "
            "free some space there, or name another folder in TMPDIR",
        ) from fault
