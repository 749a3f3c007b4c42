"""Further changes of a table: rows of units and blank rows are read, the others refused by their own names."""

from __future__ import annotations

from dataclasses import replace

from everyday_parts.case import Case, Layout


def _spoil(
    case: Case, layout: Layout, head: list[str], rows: list[list[str]], codes: tuple[str, ...], *words: str
) -> Case:
    """Write a table that has to be refused, with codes and words of the refusal."""
    layout.write(case.path, head, rows)
    return replace(
        case,
        codes=(*codes, *(case.codes or ())),
        words=(*words, *(case.words or ())) if words else (),
        must_refuse=True,
    )


def _add_units(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    """Write SI units below the header."""
    units = ["rad" if name.startswith("q_") else "Nm" if name.startswith("tau_") else "" for name in head]
    layout.write(case.path, head, [units, *rows])
    return case


def _add_degrees(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    units = ["deg" if name.startswith("q_") else "Nm" if name.startswith("tau_") else "" for name in head]
    return _spoil(case, layout, head, [units, *rows], ("file_format",), "scale")


def _add_text(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    rows[k][-1] = "ERR"
    return _spoil(case, layout, head, rows, ("bad_sample",), "ERR", "scale")


def _repeat_header(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    return _spoil(case, layout, head, [*rows[:k], head, *rows[k:]], ("file_format",), "repeats the header", "scale")


def _add_cell(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    rows[k] = [*rows[k], "0"]
    if layout.end:  # the header has a nameless column, which only that row fills; a map's reader names it by its number
        codes, words = ("missing_column", "file_format"), ("has no name", "cells, the header has")
        return _spoil(case, layout, head, rows, codes, *words)
    return _spoil(case, layout, head, rows, ("file_format",), "cells, the header has")


def _repeat_name(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    return _spoil(case, layout, [*head[:-1], head[-2]], rows, ("duplicate_name",))


def _swap_rows(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    if head[0].startswith(("q_", "tau_")):
        return _add_units(case, layout, head, rows, k)
    rows[k], rows[k + 40] = rows[k + 40], rows[k]
    return _spoil(
        case, layout, head, rows, ("bad_sample",), "comes after", "scale", "whole seconds", "Write more digits"
    )


def _add_blank_rows(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    rows = [*rows[:k], [""] * len(head), *rows[k:]]
    layout.write(case.path, head, rows)
    return case


def _write_latin(case: Case, layout: Layout, head: list[str], rows: list[list[str]], k: int) -> Case:
    rows = [[*row, "21"] for row in rows]
    return _spoil(case, replace(layout, encoding="latin-1"), [*head, "Temp °C"], rows, ("file_format",), "UTF-8")


SPOILT = {
    "units": _add_units, "degrees": _add_degrees, "text in a cell": _add_text, "header again": _repeat_header,
    "a cell too many": _add_cell, "equal names": _repeat_name, "rows exchanged": _swap_rows, "blank rows": _add_blank_rows,
    "Latin-1": _write_latin,
}  # fmt: skip
"""Changes by name, each of case, layout, header, rows and a row's number."""
