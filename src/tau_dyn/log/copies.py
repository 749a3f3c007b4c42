"""Copy of a recording too large for memory that can be read from the middle: Parquet in a temporary folder.

Text is read as tables of some lines each; every line and every cell is checked and counted as in a small file. Parquet with row
groups too large for memory is written again. The copy is deleted when it is no longer used.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.exceptions import InputError
from tau_dyn.files import get_owner_name, remove_stale_files
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import list_used_columns
from tau_dyn.log.delimited import parse_delimited
from tau_dyn.log.table import Table

CHUNK_BYTES = 2**24
"""Size of the text parsed at once."""


def iterate_text_chunks(path: Path, digest: Any = None, *, foreign: bool = False) -> Iterator[Table]:
    """Yield a delimited file's rows as tables, each with its lines' numbers in the file.

    A file that grows meanwhile is read up to its size at the start.

    Args:
        path: The file.
        digest: A hash of `hashlib` that receives every byte read.
        foreign: Whether blanks may separate cells; there has to be a header.
    """
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        head, lines, taken = _head(file, path)
        _count(digest, taken)
        left -= len(taken)
        while left > 0:
            body = _next_lines(file, left)
            left -= sum(map(len, body))
            for line in body:
                _count(digest, line)
            if not body:
                return
            if not b"".join(body).strip():
                lines += len(body)
                continue
            shift = lines - 1  # the header is line 1 of the parsed text
            try:
                cells, places, warnings, _ = parse_delimited(path.name, b"".join([head, *body]), foreign=foreign)
            except InputError as fault:
                raise InputError(fault.code, _shifted(str(fault), shift)) from None
            yield Table(
                path.name, path, "", cells, places + shift, warnings=tuple(_shifted(w, shift) for w in warnings)
            )
            lines += len(body)


def _next_lines(file: BinaryIO, left: int) -> list[bytes]:
    """Return the lines to parse at once; the last ones come together, as an incomplete line is recognised by those above it."""
    body = file.readlines(CHUNK_BYTES if left > 2 * CHUNK_BYTES else left)
    over = sum(map(len, body)) - left
    if over > 0:
        body[-1] = body[-1][:-over]
    return body


def _count(digest: Any, data: bytes) -> None:
    if digest is not None:
        digest.update(data)


def _head(file: BinaryIO, path: Path) -> tuple[bytes, int, bytes]:
    """Return the header line, the number of lines up to it, and these lines."""
    taken = []
    for number, line in enumerate(file, start=1):
        taken.append(line)
        text = line.removeprefix(b"\xef\xbb\xbf")
        if text.strip() and not text.lstrip().startswith(b"#"):
            return text if text.endswith(b"\n") else text + b"\n", number, b"".join(taken)
    raise InputError(
        "missing_column", f"{path.name} has no header; a log needs a line naming its columns and one line a sample."
    )


def _shifted(sentence: str, shift: int) -> str:
    """Return a sentence about `line 7` with that line's number in the file."""
    before, found, after = sentence.partition(", line ")
    digits = len(after) - len(after.lstrip("0123456789"))
    return (
        f"{before}{found}{int(after[:digits]) + shift}{after[digits:]}"
        if digits and int(after[:digits]) > 1
        else sentence
    )


_ROWS = 2**17
"""Rows of a row group of a copy."""


class TemporaryFolder:
    """A folder that is deleted when it is no longer used."""

    def __init__(self) -> None:
        """Create it in the system's folder for temporary files (`TMPDIR`), and delete those of killed processes."""
        remove_stale_files(Path(tempfile.gettempdir()), "tau_dyn_")
        self.path: Path = Path(tempfile.mkdtemp(prefix=f"tau_dyn_{get_owner_name()}.", suffix=".part"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class Copy(NamedTuple):
    """A copy of one or several files.

    Attributes:
        paths: Its files.
        folder: Their folder.
        digest: Hash of the copied bytes, if known.
        warnings: Sentences about lines that were left out while reading.
        texts: Columns that hold text somewhere and cannot be used.
    """

    paths: tuple[Path, ...]
    folder: TemporaryFolder
    digest: str = ""
    warnings: tuple[str, ...] = ()
    texts: frozenset[str] = frozenset()


def copy_text(path: Path, map_: ColumnMap | None) -> Copy:
    """Copy a large text file: our columns (under their own names or by a map) are checked, foreign ones kept if numeric.

    Raises:
        InputError: A line or a cell is at fault, or the copy does not fit on the disk.
    """
    folder, digest = TemporaryFolder(), hashlib.sha256()
    target, warnings, writer = folder.path / f"{path.stem}.parquet", [], None
    ours = tuple(map_.sources) if map_ is not None else ()
    theirs = {source.column: source.scale for source in map_.sources.values()} if map_ is not None else {}
    texts: set[str] = set()
    with _room_for_a_copy(path.name, folder):
        for table in iterate_text_chunks(path, digest, foreign=map_ is not None):
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
    """Yield a file's rows in tables of at most so many rows."""
    try:
        yield from file.iter_batches(batch_size=rows)
    except (pa.ArrowException, OSError) as fault:
        raise InputError("damaged_file", f"{path.name} is damaged: {str(fault).splitlines()[0]}") from None


@contextmanager
def _room_for_a_copy(name: str, folder: TemporaryFolder) -> Iterator[None]:
    """Raise an error that names the full disk if a copy does not fit."""
    try:
        yield
    except OSError as fault:
        raise InputError(
            "file_too_large",
            f"{name} is too large to be read at once, and its copy in {folder.path.parent} failed ({fault.strerror or fault}); "
            "free some space there, or name another folder in TMPDIR",
        ) from fault
