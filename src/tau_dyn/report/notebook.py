"""Results in a notebook: `render_html` gives what stands below a cell, `build_table` the table behind it.

A face is headline, judgement, one table and a few small drawings: what a colleague would look at first. Everything else is the
page's (`write_report`). The drawings and their style are the page's own; the style is scoped to the face and follows the
notebook's light or dark theme. All text is escaped by `svg.tag`; there is no script.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd
from markupsafe import Markup

from tau_dyn.report import notebook_faces, notebook_tables
from tau_dyn.report.notebook_face import Row
from tau_dyn.report.notebook_style import get_style
from tau_dyn.report.svg import format_tag

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # no text: a file name may hold what steers a terminal
MAX_ROWS = 16
"""Rows that are shown before the rest is folded away."""
LONG = 44
"""Characters above which a cell breaks into lines."""
WIDE = 480
"""Width from which a drawing is wide [px at 100 %]."""


def render_html(found: Any) -> str:
    """Return what a notebook shows of a result.

    Raises:
        TypeError: Nobody said how it looks.
    """
    face = notebook_faces.build_face(found)
    pieces = [Markup("<style>") + Markup(get_style(face.styles)) + Markup("</style>")]  # noqa: S704 our own files
    pieces.append(format_tag("p", format_tag("b", face.kind), f" {face.about}", class_="kicker"))
    if face.headline:
        said = format_tag("span", face.badge) if face.badge else ""
        pieces.append(format_tag("p", said, " ", face.headline, class_=f"headline {face.level}"))
    pieces += [_table(face.columns, face.rows)] if face.rows else []
    pieces += [format_tag("div", *map(_sized, face.pictures), class_="pictures")] if any(face.pictures) else []
    pieces += [format_tag("p", note, class_="note") for note in face.notes]
    return _CONTROL.sub("\ufffd", format_tag("div", *pieces, class_="tau-dyn"))


def build_table(found: Any) -> pd.DataFrame:
    """Return a result's main table.

    Raises:
        TypeError: It has none.
    """
    return notebook_tables.build_result_table(found)


def _table(columns: Sequence[str], rows: Sequence[Row]) -> Markup:
    """Return a table; what is beyond the first rows is folded away."""
    if len(rows) <= MAX_ROWS + 2:
        return _rows(columns, rows)
    rest = format_tag(
        "details", format_tag("summary", f"and {len(rows) - MAX_ROWS} more"), _rows(columns, rows[MAX_ROWS:])
    )
    return _rows(columns, rows[:MAX_ROWS]) + rest


def _rows(columns: Sequence[str], rows: Iterable[Row]) -> Markup:
    head = format_tag("thead", format_tag("tr", *(format_tag("th", c) for c in columns)))
    body = format_tag("tbody", *(format_tag("tr", *_cells(row), class_=row.level or None) for row in rows))
    return format_tag("table", head, body)


def _cells(row: Row) -> list[Markup]:
    long = ["long" if not isinstance(cell, Markup) and len(cell) > LONG else None for cell in row.cells]
    return [format_tag("td" if k else "th", cell, class_=long[k]) for k, cell in enumerate(row.cells)]


def _sized(picture: Markup) -> Markup:
    """Return a drawing; a wide one takes the room of several."""
    size = re.search(r'viewBox="0 0 (\d+)', picture)
    if size is None or int(size[1]) < WIDE:
        return picture
    return Markup(str(picture).replace('class="', 'class="wide ', 1))  # noqa: S704 our own drawing
