"""Delimited text (comma, semicolon or tab) split into columns, with the line number of every row.

The layout is checked here, line by line, before pandas turns cells into numbers: pandas alone pads short rows and
loses their line numbers. Byte order marks and all line ends are accepted. This module does not interpret meaning and
units. Foreign text may also be separated by blanks, and lack a header or a name in it: such columns are
numbered from 1. Spreadsheets add decimal commas, rows of separators alone, a line `sep=;`, and rows of units below
the header: all are read, with a remark.
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.log.column_names import describe_foreign_file, is_blank, is_time_text
from tau_dyn.message_codes import CodedWarning

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}

MAX_COLUMNS = 10_000
"""Largest number of columns of a table; a longer line is no header."""


_EMPTY = ' \t,;"\r'
"""Characters of a row without a cell in it; spreadsheets write separators for empty rows."""

_DECIMAL_COMMA = re.compile(r"[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?")

_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:\.\d{3})+,\d+")

_SAMPLED_LINES = 50
"""Lines with a comma from which the decimal sign is taken; a logger writes all lines by one locale."""

MAX_UNIT_ROWS = 3
"""Largest number of text rows between header and numbers: units, descriptions and types from controllers' recorders."""


class Delimited(NamedTuple):
    """A text file's columns.

    Attributes:
        cells: Columns by name, each (N,) as numbers if all its cells are numbers, else as text.
        lines: The line number (N,) of each row.
        warnings: Remarks on the layout, and on lines that were left out.
        units: Units by column, of a file with a row of units below its header.
    """

    cells: dict[str, NDArray[Any]]
    lines: NDArray[np.int64]
    warnings: tuple[str, ...]
    units: Mapping[str, str]


class _Layout(NamedTuple):
    name: str
    separator: str
    header: list[str]
    header_line: int  # its line number
    lines: list[str]  # the rows
    numbers: list[int]  # the line number of each row
    ends_with_newline: bool


def parse_delimited(name: str, data: bytes, *, foreign: bool = False) -> Delimited:
    """Split a text file into columns.

    Args:
        name: File name, for messages.
        data: The file's bytes.
        foreign: Whether blanks may separate cells and the header may be missing.

    Raises:
        InputError: The bytes are not UTF-8 or UTF-16, a header or rows are missing, a name occurs twice, or a row has
            another length.
    """
    text, remarks = _decode(name, data)
    layout = _drop_trailing_separator(_lay_out(name, text, foreign))
    layout, dropped = _check_lengths(layout)
    if _last_cell_is_cut(layout):
        dropped = (*dropped, _dropped(layout))
        layout = _without_last(layout)
    layout, units = _take_unit_rows(layout)
    frame, commas = _parse(layout)
    cells = {column: frame[position].to_numpy() for position, column in enumerate(layout.header)}
    said = [f"{name}: {remark}." for remark in (*remarks, *commas)]
    said += [f"{name}, line {layout.header_line + 1}: units below the header were left out."] if units else []
    warnings = (*dropped, *(CodedWarning("log_layout", sentence) for sentence in said))
    return Delimited(cells, np.asarray(layout.numbers, dtype=np.int64), warnings, units)


def _decode(name: str, data: bytes) -> tuple[str, list[str]]:
    """Return the text with Unix line ends and without a byte order mark, and remarks."""
    if words := describe_foreign_file(data):
        raise InputError("file_format", f"{name} is {words}.")
    wide = _find_wide_encoding(data)
    try:
        text = data.decode(wide or "utf-8-sig").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        wrong = "the UTF-16 text is damaged" if wide else f"byte 0x{data[error.start]:02x} is not UTF-8"
        raise InputError("file_format", f"{name}, line {line}: {wrong}; save the log as CSV in UTF-8.") from None
    return text.replace("\r\n", "\n").replace("\r", "\n"), ["its text is UTF-16"] if wide else []


def _find_wide_encoding(data: bytes) -> str:
    """Return the encoding of UTF-16 text, with or without a byte order mark; empty for other text."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    start = data[:64]
    zeros = [start[k::2].count(0) for k in (0, 1)]
    half = len(start) // 2
    if half < 4 or max(zeros) < half or min(zeros) > 0:
        return ""
    return "utf-16-le" if zeros[1] else "utf-16-be"


def _lay_out(name: str, text: str, foreign: bool) -> _Layout:
    """Find the header, the separator and the lines that hold rows."""
    lines = text.split("\n")
    at = next((i for i, line in enumerate(lines) if _begins_table(line)), None)
    if at is None:
        raise InputError(
            "missing_column", f"{name} has no header; a log needs a line naming its columns and one line a sample."
        )
    separator = max(SEPARATORS, key=lambda s: (lines[at].count(s), s == ","))
    if lines[at].strip('"; ,').lower().startswith("sep=") and at + 1 < len(lines):  # Excel's own line above the header
        return _lay_out(name, "\n".join(["#" if i == at else line for i, line in enumerate(lines)]), foreign)
    if foreign and _are_blanks_between(lines, at):
        lines, separator = [*lines[:at], *("\t".join(line.split()) for line in lines[at:])], "\t"
    header = [cell.strip() for cell in _cells_of(name, at + 1, lines[at], separator)]
    first_row = at + 1
    if foreign and len(header) <= MAX_COLUMNS and all(map(_is_number, header)):
        header, first_row = [str(k + 1) for k in range(len(header))], at
    else:
        header = [cell or str(k + 1) for k, cell in enumerate(header)] if foreign else header
        if not header[0] and _are_row_numbers(lines[first_row:], separator):
            header[0] = "1"
        _check_header(name, at + 1, header)
    kept = [i for i in range(first_row, len(lines)) if lines[i].strip(_EMPTY)]
    if not kept:
        raise InputError(
            "too_little_data", f"{name} ends after its header in line {at + 1}; a log needs one line a sample below it."
        )
    rows = [lines[i] for i in kept]
    if first_row > at and lines[at] in rows:
        again = kept[rows.index(lines[at])] + 1
        raise InputError(
            "file_format",
            f"{name}, line {again} repeats the header: recordings were joined there; pass them as two files.",
        )
    return _Layout(
        name, separator, header, at + 1, rows, [i + 1 for i in kept], ends_with_newline=not lines[-1].strip()
    )


def _are_row_numbers(lines: list[str], separator: str) -> bool:
    """Return whether the first cells of rows are whole numbers that rise by one, as the index that pandas writes."""
    first = [line.partition(separator)[0].strip().strip('"') for line in lines if line.strip(_EMPTY)]
    numbers = [int(cell) for cell in first if cell.isdecimal() and len(cell) < 16]
    return bool(first) and len(numbers) == len(first) and numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def _begins_table(line: str) -> bool:
    """Return whether a line is the header: the first line that has a cell and is not a comment."""
    return bool(line.strip(_EMPTY)) and not line.lstrip().startswith("#")


def _drop_trailing_separator(layout: _Layout) -> _Layout:
    """Return a layout without the empty column that a separator at the end of every line makes."""
    sign = layout.separator
    if layout.header[-1] and not layout.header[-1].isdigit() or len(layout.header) < 2:
        return layout
    if not all(
        line.endswith(sign) and _count_separators(line, sign) == len(layout.header) - 1 for line in layout.lines
    ):
        if not layout.header[-1]:
            raise InputError(
                "missing_column",
                f"{layout.name}, line {layout.header_line}: column {len(layout.header)} has no name; the header must name "
                "every column.",
            )
        return layout
    return layout._replace(header=layout.header[:-1], lines=[line[: -len(sign)] for line in layout.lines])


def _count_separators(line: str, sign: str) -> int:
    """Return the number of separators between cells of a line; a cell in quotes may hold more of them."""
    return line.count(sign) if '"' not in line else len(_cells_of("", 0, line, sign)) - 1


def _take_unit_rows(layout: _Layout) -> tuple[_Layout, dict[str, str]]:
    """Return a layout without the rows of text between header and numbers, and the units by column."""
    first = [_cells_of(layout.name, 0, line, layout.separator) for line in layout.lines[: MAX_UNIT_ROWS + 1]]
    n_above = next((k for k, cells in enumerate(first) if any(map(_is_cell_number, cells))), 0)
    above = first[:n_above]
    if not n_above or not all(_is_text_row(cells) for cells in above):
        return layout, {}
    cells = min(above, key=lambda row: sum(len(cell) for cell in row))  # units are the shortest words
    units = {column: cell.strip() for column, cell in zip(layout.header, cells, strict=True) if cell.strip()}
    return layout._replace(lines=layout.lines[n_above:], numbers=layout.numbers[n_above:]), units


def _is_text_row(cells: Sequence[str]) -> bool:
    """Return whether no cell of a row is a sample: a number, a missing number or a time."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    return bool(filled) and not any(is_blank(cell) or is_time_text(cell) or _is_list(cell) for cell in filled)


def _is_list(cell: str) -> bool:
    return cell.startswith("[") and any(c.isdigit() for c in cell)


def _is_cell_number(cell: str) -> bool:
    text = cell.strip()
    return _is_number(text) and not is_blank(text) or bool(_DECIMAL_COMMA.fullmatch(text))


def _are_blanks_between(lines: list[str], at: int) -> bool:
    """Return whether blanks separate the cells: numbers, or names without another separator, as many as in the rows below."""
    cells = lines[at].split()
    below = next((line.split() for line in lines[at + 1 :] if line.strip()), [])
    numeric = all(map(_is_number, cells))
    alike = numeric or not any(separator in lines[at] for separator in SEPARATORS) and len(below) == len(cells)
    return alike and len(cells) > 1


def _cells_of(name: str, line: int, text: str, separator: str) -> list[str]:
    """Return a line's cells; a cell longer than the csv module takes (128 KiB) is no cell."""
    try:
        return next(csv.reader([text], delimiter=separator))
    except csv.Error as fault:
        raise InputError(
            "file_format", f"{name}, line {line}: not a line of cells ({fault}); write plain CSV."
        ) from None


def _check_header(name: str, line: int, header: list[str]) -> None:
    if len(header) > MAX_COLUMNS:
        raise InputError(
            "file_too_large",
            f"{name}, line {line}: the header names {len(header)} columns; a log has {MAX_COLUMNS} at most.",
        )
    seen: set[str] = set()
    for position, column in enumerate(header, start=1):
        if not column and position == len(header) > 1:
            continue  # a separator at the line's end, which the rows show
        if not column:
            raise InputError(
                "missing_column",
                f"{name}, line {line}: column {position} has no name; the header must name every column.",
            )
        if column in seen:
            raise InputError(
                "duplicate_name",
                f"{name}, line {line}: column {column} occurs twice; every column needs a name of its own.",
            )
        seen.add(column)
    if all(_is_number(column) for column in header):
        first = ", ".join(header[:3])
        raise InputError(
            "missing_column",
            f"{name}, line {line}: the header is missing ({first} are numbers); name the columns: t,q_axis,tau_axis.",
        )


def _check_lengths(layout: _Layout) -> tuple[_Layout, tuple[str, ...]]:
    """Refuse a row with another number of cells than the header; drop an unfinished last row with a warning."""
    wanted = len(layout.header)
    counts = _count_cells(layout)
    wrong = np.flatnonzero(counts != wanted)
    if not wrong.size:
        return layout, ()
    first = int(wrong[0])
    if first == len(counts) - 1 and counts[first] < wanted and first > 0:
        return _without_last(layout), (_dropped(layout),)
    where, has = f"{layout.name}, line {layout.numbers[first]}", f"{counts[first]} cells"
    is_everywhere = wrong.size > len(counts) / 2
    if (
        layout.separator == ","
        and is_everywhere
        and wanted < counts[first] <= 2 * wanted
        and "." not in "".join(layout.lines[:20])
    ):
        raise InputError(
            "file_format",
            f"{where} has {has} and the header {wanted}: commas seem to be both decimal signs and separators; separate the "
            "cells by semicolons or tabs.",
        )
    if first == 0 and len(counts) > 1 and (counts[1:] == counts[0]).all() or wanted == 1:
        taken = layout.separator.join(layout.header)
        raise InputError(
            "file_format",
            f"{where} has {has}, and line {layout.header_line}, '{taken[:60]}', is taken for the header; the first line has to "
            "name the columns, and lines above it have to begin with #.",
        )
    raise InputError(
        "file_format",
        f"{where} has {has}, the header has {wanted}; "
        f"every line needs {wanted}, separated by {SEPARATORS[layout.separator]}.",
    )


def _count_cells(layout: _Layout) -> NDArray[np.int64]:
    """Return the number of cells of each row; quoted cells are counted by the csv module, which is slower."""
    if any('"' in line for line in layout.lines):
        rows = zip(layout.numbers, layout.lines, strict=True)
        counts = [len(_cells_of(layout.name, number, line, layout.separator)) for number, line in rows]
    else:
        counts = [line.count(layout.separator) + 1 for line in layout.lines]
    return np.asarray(counts, dtype=np.int64)


_EXACT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
)
"""Options that make pandas read each number as Python does; version 3.1 and later do so by default."""


def _parse(layout: _Layout) -> tuple[pd.DataFrame, list[str]]:
    """Let pandas turn rows into numbers, column by column; a column with anything else in it stays text."""
    decimal, thousands = _find_decimal_sign(layout)
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(layout.lines)),
            sep=layout.separator,
            header=None,
            names=list(range(len(layout.header))),
            index_col=False,
            keep_default_na=False,
            na_values=[],
            skipinitialspace=True,
            low_memory=False,
            decimal=decimal,
            thousands=thousands,
            **_EXACT,
        )
    except (pd.errors.ParserError, ValueError) as error:
        if "out of memory" in str(error):
            raise MemoryError from error
        raise InputError(
            "file_format", f"{layout.name} is not a table of cells: {str(error).splitlines()[0]}; write plain CSV."
        ) from None
    if len(frame) != len(layout.lines):
        raise InputError(
            "file_format",
            f"{layout.name} has a quoted cell that runs over its line; close every quote on its own line.",
        )
    if decimal == ".":
        return frame, []
    for column in frame.columns:
        frame[column] = _read_decimal_commas(frame[column])
    return frame, ["its numbers have decimal commas"]


def _find_decimal_sign(layout: _Layout) -> tuple[str, str | None]:
    """Return the decimal sign, and the thousands separator if there is one."""
    if layout.separator == "," and not any('"' in line for line in layout.lines):
        return ".", None
    lines = [line for line in layout.lines if "," in line][:_SAMPLED_LINES]
    cells = [cell.strip() for line in lines for cell in _cells_of(layout.name, 0, line, layout.separator)]
    if not any(map(_DECIMAL_COMMA.fullmatch, cells)):
        return ".", None
    return ",", "." if any(map(_THOUSANDS.fullmatch, cells)) else None


def _read_decimal_commas(cells: Any) -> Any:
    """Return a column of text as numbers if its cells are numbers or missing, by one of the two decimal signs.

    If most are numbers with decimal commas, these get decimal points, so that a refusal names the cells that are no numbers.
    """
    if cells.dtype.kind in "fiub":
        return cells
    text = cells.astype(str).str.strip()
    missing = text.map(is_blank)
    for shown in (text.str.replace(",", ".", regex=False), text):
        values = pd.to_numeric(shown.where(~missing), errors="coerce")
        if bool((values.notna() | missing).all()):
            return values
    pointed = text.str.replace(",", ".", regex=False)
    is_number = pd.to_numeric(pointed.where(~missing), errors="coerce").notna()
    return cells.where(~is_number, pointed) if is_number.sum() > len(text) / 2 else cells


def _last_cell_is_cut(layout: _Layout) -> bool:
    """Return whether the file stops inside its last number.

    Only a file without a final newline can. Its last cell is taken as cut when it is no number in a column of numbers, or
    when it has fewer characters, decimals or digits of an exponent than each of the 50 cells above it (`1.5` of `1.52e-05`
    would pass for a number, and `1.52e-0` as well).
    """
    if layout.ends_with_newline or len(layout.lines) < 3:
        return False
    *above, last = (line.rpartition(layout.separator)[2].strip().strip('"') for line in layout.lines[-51:])
    if not all(_is_number(cell) for cell in above):
        return False
    if not _is_number(last):
        return True
    if len(above) < 10:
        return False
    exponents = [len(cell) for cell in map(_exponent, above) if cell]
    return (
        len(last) < min(map(len, above))
        or len(_decimals(last)) < min(len(_decimals(cell)) for cell in above)
        or bool(_exponent(last))
        and len(_exponent(last)) < min(exponents, default=0)
    )


def _decimals(cell: str) -> str:
    """Return the decimal point and the digits after it."""
    return "".join(cell.lower().partition("e")[0].partition(".")[1:])


def _exponent(cell: str) -> str:
    return cell.lower().partition("e")[2]


def _without_last(layout: _Layout) -> _Layout:
    return layout._replace(lines=layout.lines[:-1], numbers=layout.numbers[:-1], ends_with_newline=True)


def _dropped(layout: _Layout) -> str:
    return f"{layout.name}, line {layout.numbers[-1]}: the last line is incomplete and was left out."


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
