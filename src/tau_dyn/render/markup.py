"""Tables and drawings as HTML, for a page and for a notebook. All text is escaped by `chart.format_tag`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from tau_dyn import results as r
from tau_dyn.render.chart import draw_colour_scale, draw_figure, format_tag

LONG = 44
"""Number of characters above which a cell is broken into lines in a notebook."""

MAX_SIGMAS = 3.0
"""Error in standard errors above which a number is highlighted, in a column of style `far`."""


def draw(drawing: r.Drawing) -> Markup:
    """Return any drawing as SVG."""
    match drawing:
        case r.Figure():
            return draw_figure(drawing)
        case r.ColourScale():
            return draw_colour_scale(drawing)
        case r.RobotPicture():
            from tau_dyn.render.sketch import draw_robot  # loads the kinematics, which many results do not need

            return draw_robot(drawing)
        case r.VectorPicture():
            from tau_dyn.render.sketch import draw_vectors

            return draw_vectors(drawing)
        case r.SwingPicture() | r.ShapePicture() | r.SpacePicture() | r.PolarPicture():
            from tau_dyn.render import pictures

            return pictures.draw_picture(drawing)
    raise TypeError(f"{type(drawing).__name__} is no drawing")


def build_table(table: r.ResultTable, on: r.On) -> Markup:
    """Return a table for a page or a notebook."""
    shown = [k for k, c in enumerate(table.columns) if c.on & on]
    columns = [table.columns[k] for k in shown]
    pieces = [format_tag("caption", table.caption)] if table.caption else []
    if any(c.title or c.scale for c in columns):
        pieces.append(format_tag("thead", format_tag("tr", *map(_build_head, columns))))
    for title, rows in [("", table.rows), *table.groups] if table.rows or not table.groups else table.groups:
        lines = [_build_row(row, columns, shown, on) for row in rows if row.on & on]
        if title:
            lines.insert(0, format_tag("tr", format_tag("th", title, colspan=len(columns)), class_="group"))
        pieces.append(format_tag("tbody", *lines))
    return format_tag("table", *pieces, class_=table.style or None)


def _build_head(column: r.Column) -> Markup:
    if column.scale:
        ends = (f"−{column.scale}", "0", f"+{column.scale}")
        return format_tag("th", *(format_tag("span", end) for end in ends), class_="bar-head")
    quiet = format_tag("span", column.title, class_="quiet") if column.kind == "bar" and column.title else column.title
    return format_tag("th", quiet, class_=_name_class(column) or None)


def _name_class(column: r.Column, cell: r.Cell = "") -> str:
    kind = {"number": "num", "unit": "unit", "interval": "bar-cell", "step": "fall"}.get(column.kind, "")
    far = column.style == "far" and isinstance(cell, str) and float(cell or 0) > MAX_SIGMAS
    return f"{kind} {'' if column.style == 'far' and not far else column.style}".strip()


def _build_row(row: r.Row, columns: Sequence[r.Column], shown: Sequence[int], on: r.On) -> Markup:
    if row.style == "fold":  # one line of text over the whole width
        name, remark = row.cells[shown[0]], row.cells[shown[-1]]
        both = (str(name), format_tag("span", str(remark), class_="remark"))
        return format_tag("tr", format_tag("th", *both, colspan=len(columns)), class_="fold")
    cells, head = [], True
    for column, cell in zip(columns, (row.cells[k] for k in shown), strict=True):
        if isinstance(cell, r.Verdict):
            cells.append(format_tag("td", format_tag("span", cell.badge), class_=f"verdict {cell.level}"))
            continue
        content = build_cell(cell, on)
        if head and row.link and on is r.On.PAGE:
            content = format_tag("a", content, href=f"#{row.link}")
        classes = [_name_class(column, cell), "long" if isinstance(cell, str) and len(cell) > LONG else ""]
        class_ = " ".join(c for c in classes if c and not (head and c == "num")) or None
        cells.append(format_tag("th" if head else "td", content, class_=class_))
        head = False
    return format_tag("tr", *cells, class_=row.style or None)


def build_cell(cell: r.Cell, on: r.On) -> Markup | str:
    """Return a cell's content."""
    match cell:
        case r.Bar():
            return _build_meter(cell)
        case r.IntervalBar():
            return _draw_interval(cell)
        case r.StepBar():
            return _build_meter(r.Bar(min(cell.share, 1.0))) if on is r.On.NOTEBOOK else _build_step(cell)
        case tuple():
            return ", ".join(map(str, cell))
    return cell or ""


def _percent(share: float) -> str:
    return f"{100 * min(max(share, 0.0), 1.0):.1f}%" if np.isfinite(share) else "0%"


def _build_meter(bar: r.Bar) -> Markup:
    start = f"left:{_percent(bar.start)};" if bar.start else ""
    filled = format_tag("i", style=f"{start}width:{_percent(bar.share - bar.start)}", class_=bar.ink or None)
    tick = [] if bar.tick is None else [format_tag("b", style=f"left:{_percent(bar.tick)}")]
    return format_tag("div", filled, *tick, class_="meter")


def _build_step(step: r.StepBar) -> Markup:
    """Return a step of a waterfall: the residual, its interval, the removed part hatched, and the noise floor dashed."""
    if not np.isfinite(step.share):
        return Markup("")
    cut = step.share > 1
    pieces = [format_tag("i", style=f"width:{_percent(step.share)}")]
    if step.previous > step.share:
        took = f"left:{_percent(step.share)};width:{_percent(min(step.previous, 1.0) - step.share)}"
        pieces.append(format_tag("s", style=took))
    if not cut and np.isfinite(step.low):
        pieces.append(
            format_tag("u", style=f"left:{_percent(step.low)};width:{_percent(min(step.high, 1.0) - step.low)}")
        )
    rung = format_tag("div", *pieces, class_="rung cut" if cut else "rung")
    floor = step.kind != "floor" and np.isfinite(step.floor)
    return rung + (format_tag("em", style=f"left:{_percent(step.floor)}") if floor else Markup(""))


def _draw_interval(bar: r.IntervalBar) -> Markup:
    """Return an estimate and its 95 % interval around the reference in the centre, cut at the ends of the scale."""

    def x(share: float) -> float:
        return 70.0 + 64.0 * share

    pieces = [format_tag("path", d="M6 9H134", class_="bar-axis")]
    if bar.trust:
        pieces.append(format_tag("rect", x=x(-bar.trust), y=4, width=128.0 * bar.trust, height=10, class_="bar-trust"))
    if bar.anchored:
        pieces.append(format_tag("path", d="M70 2V16", class_="bar-nominal"))
    right = max(x(bar.high), x(bar.low) + 0.5)
    pieces.append(format_tag("path", d=f"M{x(bar.low):.1f} 9H{right:.1f}", class_="bar-interval"))
    if bar.low <= -1:
        pieces.append(format_tag("path", d="M7 5L2 9L7 13", class_="bar-cut"))
    if bar.high >= 1:
        pieces.append(format_tag("path", d="M133 5L138 9L133 13", class_="bar-cut"))
    if bar.at is not None:
        pieces.append(format_tag("circle", cx=x(bar.at), cy=9, r=3.4, class_="bar-dot"))
    size = {"viewBox": "0 0 140 18", "width": 140, "height": 18}
    return format_tag("svg", *pieces, **size, class_=f"bar {bar.state}".strip(), aria_hidden="true")
