"""A file of columns, with the place of every cell, before anything is known about their meaning.

`read_table` turns CSV or Parquet into a `Table`; cells become numbers only when a column is asked for, so that a fault is
named with its line and column, while columns that nobody uses may hold anything. Lines are counted as an editor counts them:
comments and header included, from 1. The splitting of text lives in `delimited.py`; what the columns mean, in `read.py`. A few
bytes can say that they are gigabytes, which recordings never do: how far a file may grow is limited here.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.log.column_names import describe_bad_cell, describe_missing_column, is_unit_row
from tau_dyn.log.delimited import MAX_COLUMNS, parse_delimited

MAX_INFLATION_RATIO = 200
"""How many times its size a file may become, beside `FREE_BYTES` bytes; recorders reach about ten times."""

FREE_BYTES = 2**26  # bytes; small files may inflate as they like


class DecompressionLimit:
    """Counts what comes out of a file's chunks."""

    def __init__(self, path: Path) -> None:
        """Count for this file."""
        self.name, self.left = path.name, FREE_BYTES + MAX_INFLATION_RATIO * path.stat().st_size

    def take(self, n: int) -> None:
        """Take `n` bytes, or refuse the file."""
        self.left -= n
        if self.left < 0:
            raise InputError(
                "file_too_large",
                f"{self.name} inflates to more than {MAX_INFLATION_RATIO} times its size, which no recording does; "
                f"record it again.",
            )


MAX_MAGNITUDE = 1e15
"""No quantity of a robot in SI units is larger; what is comes from a broken logger."""

PARQUET_SUFFIXES = (".parquet", ".pq")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file as they stand there.

    Attributes:
        name: File name, for messages.
        path: Where it was read from.
        sha256: Hash of the file's bytes.
        cells: Columns by name, each (N,), as numbers or as text.
        places: Where each row stands, for messages: line numbers (N,) of a text file, row numbers from 1 of a Parquet
            file.
        place: The word for it, `line` or `row`.
        warnings: What was left out while reading.
    """

    name: str
    path: Path
    sha256: str
    cells: dict[str, NDArray[Any]]
    places: NDArray[np.int64]
    place: str = "line"
    warnings: tuple[str, ...] = ()

    @property
    def n_rows(self) -> int:
        """Number of rows N."""
        return int(self.places.size)

    def where(self, row: int) -> str:
        """Return the file and the line of a row, to open a message."""
        return f"{self.name}, {self.place} {self.places[row]}"

    def numbers(self, column: str, scale: float = 1.0) -> NDArray[np.float64]:
        """Return a column (N,) in which every cell has to be a finite number.

        Args:
            column: Its name.
            scale: What brings it to SI units, where its size is judged; the column itself is not scaled.

        Raises:
            InputError: The column does not exist, or a cell is empty, text, NaN or infinite.
        """
        if column not in self.cells:
            raise InputError("missing_column", describe_missing_column(self.name, column, tuple(self.cells)))
        values = _to_float(self.cells[column])
        wrong = np.flatnonzero(~(np.abs(values) * abs(scale) < MAX_MAGNITUDE))
        if wrong.size:
            row, cells = int(wrong[0]), self.cells[column]
            if row == 0 and len(cells) > 1 and is_unit_row(cells[0], cells[1]):
                raise InputError(
                    "bad_sample", f"{self.where(0)} holds units ({column}: {cells[0]}), not a sample; delete that line."
                )
            raise InputError(
                "bad_sample", f"{self.where(row)}, column {column}: {describe_bad_cell(cells[row], MAX_MAGNITUDE)}."
            )
        return values

    def numbers_or_none(self, column: str) -> NDArray[np.float64] | None:
        """Return a column (N,) that nobody relies on, empty cells as NaN, or None where it holds text."""
        cells = self.cells[column]
        values = _to_float(cells)
        missing = np.flatnonzero(np.isnan(values))
        return values if all(_is_blank(cells[row]) for row in missing) else None

    def first_rows(self, n: int, warning: str) -> Table:
        """Return the first `n` rows, with a sentence about the rest."""
        cells = {key: value[:n] for key, value in self.cells.items()}
        return Table(self.name, self.path, self.sha256, cells, self.places[:n], self.place, (*self.warnings, warning))


def read_table(path: str | Path, *, most: int | None = None) -> Table:
    """Read a CSV or Parquet file as a table of columns, without asking what they mean.

    A comma, a semicolon or a tab separates the cells; the header line decides which. `#` lines before the header are
    comments. An incomplete last line is left out with a warning.

    Args:
        path: The file; `.parquet` and `.pq` are read as Parquet, everything else as text.
        most: Largest size [bytes]; None for any.

    Raises:
        InputError: The file cannot be read, is larger, empty, not UTF-8, has no rows, names a column twice or has a row of
            another length.
    """
    path = Path(path)
    data = _read_bytes(path, most)
    digest = hashlib.sha256(data).hexdigest()
    if path.suffix.lower() in PARQUET_SUFFIXES:
        cells = _parquet_columns(path.name, data)
        rows = np.arange(1, len(next(iter(cells.values()), ())) + 1)
        return Table(path.name, path, digest, cells, rows, place="row")
    if path.suffix.lower() == ".mcap":
        raise InputError(
            "file_format", f"{path.name} is an MCAP file, which cannot be read here; export it as CSV or Parquet."
        )
    cells, lines, warnings = parse_delimited(path.name, data)
    return Table(path.name, path, digest, cells, lines, warnings=warnings)


def _read_bytes(path: Path, most: int | None) -> bytes:
    try:
        data = read_bytes(path, most)
    except FileNotFoundError:
        raise InputError(
            "file_not_found", f"{path}: there is no such file; give the path of a CSV or Parquet log."
        ) from None
    except IsADirectoryError:
        raise InputError("cannot_read", f"{path} is a folder; give the path of a CSV or Parquet log in it.") from None
    except OSError as error:
        raise InputError(
            "cannot_read", f"{path} cannot be read: {error.strerror or error}; give a readable CSV or Parquet log."
        ) from None
    if not data:
        raise InputError("damaged_file", f"{path.name} is empty; a log needs a header line and one line a sample.")
    return data


def _parquet_columns(name: str, data: bytes) -> dict[str, NDArray[Any]]:
    """Return the columns of a Parquet file; no Python object is ever restored from it."""
    try:
        about = pq.read_metadata(pa.BufferReader(data))
        names = Counter(about.schema.to_arrow_schema().names)
        if twice := [column for column, times in names.items() if times > 1]:  # which pyarrow calls no Parquet
            raise InputError(
                "duplicate_name", f"{name} names column {twice[0]} twice; every column needs a name of its own."
            )
        if 8 * about.num_rows * about.num_columns > FREE_BYTES + MAX_INFLATION_RATIO * len(data):
            raise InputError(
                "file_format",
                f"{name} says in {len(data)} bytes that it holds {about.num_rows} rows of {about.num_columns} columns, which no "
                "recording does; write it again.",
            )
        table = pq.read_table(pa.BufferReader(data))
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError):  # ValueError: a name that is no UTF-8
        raise InputError(
            "file_format", f"{name} is not a Parquet file; give CSV another suffix than .parquet."
        ) from None
    if table.num_rows == 0:
        raise InputError("too_little_data", f"{name} has columns but no rows; a log needs one row a sample.")
    if len(names) > MAX_COLUMNS:
        raise InputError("file_too_large", f"{name} has {len(names)} columns; a log has {MAX_COLUMNS} at most.")
    return {column: read_parquet_column(name, column, table.column(column)) for column in table.column_names}


def read_parquet_column(name: str, column: str, cells: pa.ChunkedArray) -> NDArray[Any]:
    """Return a Parquet file's column (N,) as numbers or text.

    Raises:
        InputError: Its values cannot be had, such as a date far from ours, or text that is no UTF-8.
    """
    try:
        return cells.to_pandas().to_numpy()
    except (pa.ArrowException, ValueError, OverflowError, TypeError) as fault:
        raise InputError(
            "file_format",
            f"{name}, column {column}: its {cells.type} cannot be read ({' '.join(str(fault).split())[:200]}).",
        ) from None


def _to_float(cells: NDArray[Any]) -> NDArray[np.float64]:
    """Return cells as float64, with NaN where one is not a number."""
    if cells.dtype.kind in "fiu":
        return cells.astype(np.float64)
    if cells.dtype.kind in "bmM":
        return np.full(cells.shape, np.nan)
    try:
        return np.asarray(pd.to_numeric(pd.Series(cells), errors="coerce"), dtype=np.float64)
    except OverflowError:  # a whole number of hundreds of digits stays one
        shown = pd.Series([str(cell) + ".0" if isinstance(cell, int) else cell for cell in cells])
        return np.asarray(pd.to_numeric(shown, errors="coerce"), dtype=np.float64)


def _is_blank(cell: object) -> bool:
    return cell is None or str(cell).strip().lower() in ("", "nan", "na", "null", "<na>", "none")
