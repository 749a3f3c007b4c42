"""A file of columns with the place of every cell, without the meaning of the columns.

`read_table` turns CSV or Parquet into a `Table`; cells become numbers only when a column is requested, so that a fault is
named with its line and column, while unused columns may hold anything. Lines are counted as in an editor: comments and header
included, from 1. `delimited.py` splits text; `read.py` interprets the columns. A few bytes can expand to gigabytes, which
recordings never do: this module limits how far a file may grow.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.log.column_names import describe_bad_cell, describe_missing_column, is_blank, is_unit_row
from tau_dyn.log.delimited import MAX_COLUMNS, parse_delimited

MAX_INFLATION_RATIO = 200
"""Largest expansion of a file, in multiples of its size, in addition to `FREE_BYTES` bytes; recorders reach about ten."""

FREE_BYTES = 2**26  # bytes; small files may inflate as they like


class DecompressionLimit:
    """Limit on the bytes that a file's chunks expand to."""

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
"""No quantity of a robot in SI units is larger; larger values come from a broken logger."""

MAX_LIST_LENGTH = 64
"""Numbers in a cell's list; longer ones are pictures or clouds, not signals."""

_LIST = re.compile(r"\[[^\[\]]*\]")

PARQUET_SUFFIXES = (".parquet", ".pq")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file, without conversion.

    Attributes:
        name: File name, for messages.
        path: The file it was read from.
        sha256: Hash of the file's bytes.
        cells: Columns by name, each (N,), as numbers or as text.
        places: Place of each row, for messages: line numbers (N,) of a text file, row numbers from 1 of a Parquet
            file.
        place: The word for it, `line` or `row`.
        warnings: Sentences about lines that were left out while reading.
        units: Units by column, of a text file with a row of units below its header.
    """

    name: str
    path: Path
    sha256: str
    cells: dict[str, NDArray[Any]]
    places: NDArray[np.int64]
    place: str = "line"
    warnings: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def n_rows(self) -> int:
        """Number of rows N."""
        return int(self.places.size)

    def where(self, row: int) -> str:
        """Return the file and the line of a row, to open a message."""
        return f"{self.name}, {self.place} {self.places[row]}"

    def numbers(self, column: str, scale: float = 1.0, *, gaps: bool = False) -> NDArray[np.float64]:
        """Return a column (N,) in which every cell has to be a finite number.

        Args:
            column: Its name.
            scale: Factor to SI units for the test of its size; the column itself is not scaled.
            gaps: Whether cells may be empty or `nan`; they come as NaN.

        Raises:
            InputError: The column does not exist, or a cell is empty, text, NaN or infinite.
        """
        if column not in self.cells:
            raise InputError("missing_column", describe_missing_column(self.name, column, tuple(self.cells)))
        values = _to_float(self.cells[column])
        wrong = np.flatnonzero(~(np.abs(values) * abs(scale) < MAX_MAGNITUDE))
        if gaps:
            cells = self.cells[column]
            present = (
                ~np.isnan(values[wrong]) if cells.dtype.kind == "f" else [not is_blank(cells[row]) for row in wrong]
            )
            wrong = wrong[np.asarray(present, dtype=bool)]
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
        """Return an optional column (N,), empty cells as NaN, true as 1, or None if it holds text."""
        cells = self.cells[column]
        text = cells.astype(str)
        if cells.dtype.kind == "b" or cells.size and set(text) <= {"True", "False"}:
            return (text == "True").astype(np.float64)
        values = _to_float(cells)
        missing = np.flatnonzero(np.isnan(values))
        return values if all(is_blank(cells[row]) for row in missing) else None

    def first_rows(self, n: int, warning: str) -> Table:
        """Return the first `n` rows, with a sentence about the rest."""
        return replace(self.take_rows(np.arange(n)), warnings=(*self.warnings, warning))

    def take_rows(self, rows: NDArray[np.int64]) -> Table:
        """Return some of the rows."""
        cells = {key: value[rows] for key, value in self.cells.items()}
        return replace(self, cells=cells, places=self.places[rows])


def read_table(path: str | Path, *, most: int | None = None, foreign: bool = False) -> Table:
    """Read a CSV or Parquet file as a table of columns, without interpreting them.

    A comma, a semicolon or a tab separates the cells; the header line decides which. `#` lines before the header are
    comments. An incomplete last line is left out with a warning. Lists of numbers become a column each: `state[0]`.

    Args:
        path: The file; `.parquet` and `.pq` are read as Parquet, everything else as text.
        most: Largest size [bytes]; None for any.
        foreign: Whether blanks may separate a text's cells, the header may be missing, and a cell be a list `[1, 2]`.

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
    cells, lines, warnings, units = parse_delimited(path.name, data, foreign=foreign)
    if foreign:
        cells = _spread_lists(path.name, {column: _read_lists(values) for column, values in cells.items()})
    return Table(path.name, path, digest, cells, lines, warnings=warnings, units=units)


def _read_bytes(path: Path, most: int | None) -> bytes:
    try:
        data = read_bytes(path, most)
    except FileNotFoundError:
        raise InputError(
            "file_not_found", f"{path}: there is no such file; give the path of a CSV or Parquet log."
        ) from None
    except IsADirectoryError:
        raise InputError(
            "cannot_read",
            f"{path} is a folder; give the path of a CSV or Parquet log in it. If its files are one recording, `tau-dyn "
            "columns FOLDER ROBOT` proposes a map that joins them.",
        ) from None
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
    cells = {column: table.column(column) for column in table.column_names}
    return _spread_lists(
        name,
        {
            column: _flatten_lists(values) if _is_list(values.type) else read_parquet_column(name, column, values)
            for column, values in cells.items()
        },
    )


def _is_list(kind: pa.DataType) -> bool:
    """Return whether cells are lists of numbers."""
    lists = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    return lists and (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type))


def _flatten_lists(cells: pa.ChunkedArray) -> NDArray[Any]:
    """Return lists of one length k as numbers (N, k), others as text (N,)."""
    lengths = pc.list_value_length(cells).to_numpy()
    k = lengths[0] if lengths.size else np.nan
    if not 0 < k <= MAX_LIST_LENGTH or np.any(lengths != k):
        return np.full(len(cells), "list", dtype=object)
    return pc.list_flatten(cells).to_numpy().astype(np.float64).reshape(len(cells), int(k))


def _read_lists(cells: NDArray[Any]) -> NDArray[Any]:
    """Return a text's cells as numbers (N, k) if all of them are lists `[1, 2]` of one length, else unchanged."""
    if cells.dtype.kind in "fiub" or not all(isinstance(cell, str) and _LIST.fullmatch(cell.strip()) for cell in cells):
        return cells
    rows = [cell.strip(" []").replace(",", " ").split() for cell in cells]
    if len({len(row) for row in rows}) != 1 or not 0 < len(rows[0]) <= MAX_LIST_LENGTH:
        return cells
    return np.column_stack([_to_float(np.array(column, dtype=object)) for column in zip(*rows, strict=True)])


def _spread_lists(name: str, cells: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return lists (N, k) as k columns `NAME[0]`, .. (N,)."""
    spread: dict[str, NDArray[Any]] = {}
    for column, values in cells.items():
        parts = {column: values} if values.ndim == 1 else {f"{column}[{i}]": part for i, part in enumerate(values.T)}
        if twice := [part for part in parts if part in spread or values.ndim > 1 and part in cells]:
            raise InputError("duplicate_name", f"{name} has a column {twice[0]} and a list of that name; rename one.")
        spread |= parts
    if len(spread) > MAX_COLUMNS:
        raise InputError("file_too_large", f"{name} has {len(spread)} columns; a log has {MAX_COLUMNS} at most.")
    return spread


def read_parquet_column(name: str, column: str, cells: pa.ChunkedArray) -> NDArray[Any]:
    """Return a Parquet file's column (N,) as numbers or text; bytes and nested types, such as lists, as their type's name.

    Raises:
        InputError: Its values cannot be read, such as a date out of range, or text that is not UTF-8.
    """
    if pa.types.is_nested(cells.type) or "binary" in str(cells.type):
        return np.full(len(cells), str(cells.type), dtype=object)
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
