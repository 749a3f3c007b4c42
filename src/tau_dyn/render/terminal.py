"""A presentation in the terminal: the headline, then the bars, then uncertain results, then written files.

The output is plain text within 100 columns, with a margin and bars of block characters. It is not parsed as markup, so that no
name can style a line or control the terminal; no line ends in blanks. Colour only marks meaning and is dropped if the output is
piped. Numbers and bars are never broken in a narrow terminal: optional columns are dropped, wide tables are split, and only
words wrap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import shorten, wrap
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table as Grid
from rich.text import Text as Said

from tau_dyn import results as r
from tau_dyn.render.presentation import present

MARGIN = (0, 0, 0, 2)
GAP = 3  # columns between two columns of a table: two of padding, one of the box
MIN_BAR, MAX_BAR = 4, {90: 24, 0: 16}
"""Shortest bar, and the longest bar by the smallest width of the terminal; words take the rest."""
MAX_SENTENCE = 240  # characters of a sentence in a summary, three lines
LEVEL_STYLE = {"good": "green", "care": "yellow", "poor": "bold red"}
ROW_STYLE = {"weak": "dim", "unseen": "dim", "quiet": "dim", "changed": "bold", "start": "", "cause": "", "floor": ""}
_EIGHTHS = " ▏▎▍▌▋▊▉█"


def print_result(
    console: Console,
    result: Any,
    written: Mapping[str, str] | None = None,
    *,
    wide_tables: bool = False,
    **options: Any,
) -> None:
    """Print any result for a person.

    Args:
        console: The console.
        result: The result, or its presentation.
        written: Written files, such as `{"report": "m.html"}`, for the last lines.
        wide_tables: Whether a table may be wider than the console so that its names and numbers stay whole, as in a file.
        options: Options of `present` for this kind of result.
    """
    shown = result if isinstance(result, r.Presentation) else present(result, **options)
    about = [shown.about] if shown.about and shown.about not in shown.summary else []
    say(console, " · ".join([*about, *([shown.summary] if shown.summary else [])]), "dim")
    if shown.headline:
        say(console, shown.headline, "bold")
    if shown.verdict is not None and shown.verdict.sentence:
        say(console, shown.verdict.sentence, LEVEL_STYLE[shown.verdict.level])
    for block in shown.list_blocks(r.On.TERMINAL):
        _print_block(console, block, wide=wide_tables)
    if written:
        say(console, "\n".join(f"{what} → {path}" for what, path in written.items()))


def summarise(result: Any) -> str:
    """Return a result in a few lines, as in `repr`: subject, inputs, headline, verdict, warnings."""
    shown = present(result)
    said = [f"{type(result).__name__}: {shown.about}", shown.summary, shown.headline]
    if shown.verdict is not None:
        said.append(f"{shown.verdict.badge}. {shown.verdict.sentence}")
    if shown.warnings:
        said.append(f"{r.count(len(shown.warnings), 'warning')}, first: {shown.warnings[0]}")
    lines: list[str] = []
    for text in filter(None, said):
        plain = shorten(escape_control_characters(text).plain, MAX_SENTENCE, placeholder=" ...")
        lines += wrap(plain, 88, initial_indent="  " if lines else "", subsequent_indent="  ")
    return "\n".join(lines)


def say(console: Console, text: str, style: str = "") -> None:
    """Print a paragraph after an empty line."""
    put(console, escape_control_characters(text, style))


def put(console: Console, what: Said | Grid, columns: int | None = None) -> None:
    """Print a text or a table after an empty line, within the margin and `columns`, by default the available width."""
    console.print()
    options = console.options.update(width=columns or measure_columns(console))
    for line in console.render_lines(Padding(what, MARGIN, expand=False), options, pad=False):
        console.print(Segments([*_trim(line), Segment.line()]), end="", no_wrap=True, crop=False)


def measure_columns(console: Console) -> int:
    """Return the number of usable columns."""
    return min(console.width, 100)


def escape_control_characters(text: str, style: str = "") -> Said:
    """Return text without control characters, by which a file name could control the terminal."""
    return Said("".join(c if c.isprintable() or c == "\n" else "�" for c in text), style)


def draw_meter(share: float, width: int) -> str:
    """Return a bar over a share, 0 to 1, of `width` columns; at least an eighth of a column, cut at the full width."""
    if share > 1:
        return f"{draw_meter(1.0, width - 4)}╱╱{draw_meter(1.0, 2)}"
    eighths = max(1, round(8 * width * max(share, 0.0)))
    return "█" * (eighths // 8) + (_EIGHTHS[eighths % 8] if eighths % 8 else "")


def _print_block(console: Console, block: r.Element, *, wide: bool) -> None:
    if isinstance(block, r.ResultTable):
        columns = max(measure_columns(console), measure_table(block) if wide else 0)
        for grid in build_grids(block, columns):
            put(console, grid, columns)
        more = len([row for row in block.all_rows if row.on & r.On.TERMINAL]) - block.most
        if block.most and more > 0:
            say(console, f"and {more} {block.rest}", "dim")
    elif isinstance(block, r.Text):
        say(console, block.text, "dim" if block.style in ("dim", "note") else "")
    elif isinstance(block, r.Listing):
        put(console, _build_listing(block))


def _build_listing(block: r.Listing) -> Said | Grid:
    """Return a title followed by its only sentence, or with several sentences below."""
    start = f"{block.title}: " if block.title else ""
    if len(block.items) == 1 or not block.title:
        return escape_control_characters("\n".join(f"{start}{item}" for item in block.items))
    table = Grid(box=None, show_header=False, padding=0, pad_edge=False)
    table.add_column(overflow="fold")
    table.add_row(escape_control_characters(f"{block.title}:"))
    for item in block.items:
        table.add_row(Padding(escape_control_characters(item), MARGIN))
    return table


def measure_table(table: r.ResultTable) -> int:
    """Return the columns in which a table keeps its names, numbers and words whole without the parts that it can spare."""
    rows, shown = _select_shown(table)
    least = _measure_columns(table, rows, shown, whole=False)
    needed = [k for k in shown if not table.columns[k].spare]
    kept = [k for k in shown if table.columns[k].kept]
    parts = [[*kept, k] for k in shown if k not in kept] if kept else [needed]
    return MARGIN[3] + max((_sum(least, part) for part in parts if part), default=0)


def build_grids(table: r.ResultTable, columns: int) -> list[Grid]:
    """Return a table as one or more tables that fit into `columns`."""
    rows, shown = _select_shown(table)
    room = columns - MARGIN[3]
    wide = _measure_columns(table, rows, shown)
    kept = [k for k in shown if table.columns[k].kept]
    if not kept:
        while _sum(wide, shown) > room and any(table.columns[k].spare for k in shown):
            shown.remove(next(k for k in reversed(shown) if table.columns[k].spare))
        return [_build_grid(table, rows, shown, wide, room)]
    parts: list[list[int]] = [[]]
    for k in (k for k in shown if k not in kept):
        if parts[-1] and _sum(wide, [*kept, *parts[-1], k]) > room:
            parts.append([])
        parts[-1].append(k)
    return [_build_grid(table, rows, [*kept, *part], wide, room) for part in parts]


def _select_shown(table: r.ResultTable) -> tuple[Sequence[r.Row], list[int]]:
    """Return the rows and the numbers of the columns for a terminal."""
    rows = [row for row in table.all_rows if row.on & r.On.TERMINAL]
    shown = [k for k, c in enumerate(table.columns) if c.on & r.On.TERMINAL and c.kind != "interval"]
    return rows[: table.most] if table.most else rows, shown


def _measure_columns(
    table: r.ResultTable, rows: Sequence[r.Row], shown: Sequence[int], *, whole: bool = True
) -> dict[int, int]:
    """Return the required width of columns, with their text on one line or, if not `whole`, with a word a line."""
    return {k: _measure(table.columns[k], [row.cells[k] for row in rows], whole=whole) for k in shown}


def _sum(wide: Mapping[int, int], shown: Sequence[int]) -> int:
    return sum(wide[k] for k in shown) + GAP * (len(shown) - 1)


def _measure(column: r.Column, cells: Sequence[r.Cell], *, whole: bool) -> int:
    """Return the required width of a column; text and bars share the remaining width."""
    if column.kind in ("bar", "step"):
        return max(MIN_BAR, len(column.title))
    words = [x.badge if isinstance(x, r.Verdict) else x if isinstance(x, str) else "" for x in cells]
    wraps = column.kind == "text" and not whole
    return max(
        (len(line) for text in (column.title, *words) for line in (text.split() if wraps else text.split("\n"))),
        default=0,
    )


def _build_grid(
    table: r.ResultTable, rows: Sequence[r.Row], shown: Sequence[int], wide: Mapping[int, int], room: int
) -> Grid:
    grid = Grid(box=box.SIMPLE_HEAD, padding=(0, GAP - 1, 0, 0), pad_edge=False, show_edge=False, header_style="dim")
    columns = [table.columns[k] for k in shown]
    grid.show_header = any(c.title for c in columns)
    left = room - _sum(wide, shown)
    least = _measure_columns(table, rows, shown[1:], whole=False)
    named = max(room - _sum(least, shown[1:]) - GAP, MIN_BAR) if left < 0 and columns[0].kind == "text" else room
    for n, column in enumerate(columns):
        words = column.kind == "text" and (n > 0 or wide[shown[0]] > named)
        head = escape_control_characters(column.title, "dim")
        justify = "right" if column.kind == "number" else "left"
        grid.add_column(head, justify=justify, no_wrap=not words, overflow="fold")
    longest = next(bar for least, bar in MAX_BAR.items() if room >= least)
    bar = int(np.clip(MIN_BAR + left, MIN_BAR, longest))
    left -= bar - MIN_BAR if any(c.kind in ("bar", "step") for c in columns) else 0
    for row in rows:
        cells = (_write(row.cells[k], c, bar, left, row) for k, c in zip(shown, columns, strict=True))
        grid.add_row(*(_break_names(cell, named) if n == 0 else cell for n, cell in enumerate(cells)))
    return grid


def _break_names(text: Said, columns: int) -> Said:
    """Return text in which a word longer than `columns` breaks after its last `.` or `_` that fits."""
    words = []
    for word in text.plain.split(" "):
        lines = [word]
        while len(lines[-1]) > columns and (at := max(lines[-1].rfind(c, 0, columns) for c in "._")) > 0:
            lines[-1:] = [lines[-1][: at + 1], lines[-1][at + 1 :]]
        words.append("\n".join(lines))
    return Said(" ".join(words), text.style)


def _write(cell: r.Cell, column: r.Column, bar: int, left: int, row: r.Row) -> Said:
    style = ROW_STYLE.get(row.style, "")
    if isinstance(cell, r.Bar | r.StepBar):
        if not np.isfinite(cell.share):
            return Said("")
        ink = "" if isinstance(cell, r.Bar) else "cyan" if cell.kind == "cause" else "dim"
        return escape_control_characters(draw_meter(cell.share, bar), ink)
    if isinstance(cell, r.Verdict):
        return escape_control_characters(cell.badge, LEVEL_STYLE[cell.level])
    if isinstance(cell, tuple):
        return escape_control_characters(_fit(cell, left), "dim")
    text = cell if isinstance(cell, str) else ""
    return escape_control_characters(text, style or {"strong": "bold", "quiet": "dim"}.get(column.style, ""))


def _fit(pieces: Sequence[str], columns: int) -> str:
    """Return as many complete phrases as fit."""
    text = ""
    for piece in pieces:
        longer = f"{text}, {piece}" if text else piece
        if len(longer) > columns:
            break
        text = longer
    return text


def _trim(line: list[Segment]) -> list[Segment]:
    """Return a line without trailing blanks."""
    line = list(line)
    while line and not line[-1].text.strip():
        line.pop()
    return [*line[:-1], Segment(line[-1].text.rstrip(), line[-1].style)] if line else []
