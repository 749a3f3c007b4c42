"""Maps over a flat section: bands of colour with level lines between them, as a catalogue prints an accuracy or stiffness map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from tau_dyn.report.svg import BOTTOM, HALF, LEFT, RIGHT, TOP, Chart, choose_ticks, format_tag

FINE = 4
"""Points drawn between two of the grid, to a side."""
WIDTH, LEGEND = HALF, 66
COLOURS = ("#f3f0dd", "#fbe29a", "#f6bf5f", "#ee9748", "#dd6b44", "#c1434d", "#98285a", "#6a1a5d", "#41114f", "#210a37")
"""From light to dark, so that it prints in grey and reads without colour vision."""


@dataclass(frozen=True, eq=False)
class Map:
    """Values on a grid.

    Attributes:
        u: Horizontal coordinates (nu,).
        v: Vertical coordinates (nv,).
        values: (nv, nu), nan outside.
        title: What is shown.
        xlabel: Horizontal axis.
        ylabel: Vertical axis.
        unit: Of the values, for the legend.
        marks: Points of interest (K, 2), such as guideways.
        mark_names: Their names.
    """

    u: np.ndarray
    v: np.ndarray
    values: np.ndarray
    title: str
    xlabel: str
    ylabel: str
    unit: str
    marks: np.ndarray
    mark_names: tuple[str, ...] = ()


def draw_level_plot(map_: Map, limits: tuple[float, float] | None = None) -> Markup:
    """Return the drawing: one path a band of colour, one a level line, and a legend; both axes to one scale."""
    map_ = _cropped(map_)
    low, high = limits or _limits(map_.values)
    levels = _levels(low, high)
    chart = _chart(map_)
    fine_u, fine_v, fine = _refined(map_.u, map_.v, map_.values)
    bands = [_band(chart, fine_u, fine_v, fine, a, b, c, b == levels[-1])
             for a, b, c in zip(levels[:-1], levels[1:], _colours(len(levels) - 1), strict=True)]  # fmt: skip
    lines = [
        format_tag("path", d=_level_line(chart, fine_u, fine_v, fine, level), class_="level") for level in levels[1:-1]
    ]
    return _whole(chart, map_, [*bands, *lines, *_marks(chart, map_)], levels)


def _cropped(map_: Map) -> Map:
    """Return the map without empty rows and columns at its edges."""
    rows, columns = (np.flatnonzero(np.isfinite(map_.values).any(axis=a)) for a in (1, 0))
    if not rows.size or rows[0] == rows[-1] or columns[0] == columns[-1]:
        return map_
    r, c = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return replace(map_, u=map_.u[c], v=map_.v[r], values=map_.values[r, c])


def _limits(values: np.ndarray) -> tuple[float, float]:
    there = values[np.isfinite(values)]
    if not there.size:
        return 0.0, 1.0
    low, high = float(there.min()), float(np.quantile(there, 0.98))
    return (low, high) if high > low * (1 + 1e-9) else (low, low + (abs(low) or 1.0) * 1e-3)


def _levels(low: float, high: float) -> np.ndarray:
    inner = choose_ticks(low, high, about=8)
    step = inner[1] - inner[0] if len(inner) > 1 else high - low
    return np.concatenate([[inner[0] - step], inner, [inner[-1] + step]])


def _colours(n: int) -> list[str]:
    return [COLOURS[round(k * (len(COLOURS) - 1) / max(n - 1, 1))] for k in range(n)]


def _chart(map_: Map) -> Chart:
    u, v = map_.u, map_.v
    air = 0.03 * max(np.ptp(u), np.ptp(v))
    marks = map_.marks.reshape(-1, 2)
    near = marks[_near(marks, map_)]
    xlim = min(u[0], *near[:, 0], u[0]) - air, max(u[-1], *near[:, 0], u[-1]) + air
    ylim = min(v[0], *near[:, 1], v[0]) - air, max(v[-1], *near[:, 1], v[-1]) + air
    scale = (WIDTH - LEFT - RIGHT - LEGEND) / (xlim[1] - xlim[0])
    height = float(np.clip(scale * (ylim[1] - ylim[0]), 120, 560))
    return Chart(WIDTH - LEGEND, round(height) + TOP + BOTTOM, xlim, ylim, map_.title, map_.xlabel, map_.ylabel)


def _near(marks: np.ndarray, map_: Map) -> np.ndarray:
    """Return which marks are worth widening the picture for (K,)."""
    reach = 0.35 * max(np.ptp(map_.u), np.ptp(map_.v))
    low, high = np.array([map_.u[0], map_.v[0]]) - reach, np.array([map_.u[-1], map_.v[-1]]) + reach
    return np.all((marks > low) & (marks < high), axis=1)


def _refined(u: np.ndarray, v: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values between the grid's points, linear; nan next to a missing one, except at the point itself."""
    for axis in (0, 1):
        n = values.shape[axis]
        at = np.arange((n - 1) * FINE + 1) / FINE
        k = np.minimum(at.astype(int), n - 2)
        share = (at - k).reshape(-1, *[1] * (1 - axis))
        a, b = np.take(values, k, axis), np.take(values, k + 1, axis)
        values = np.where(share == 0, a, np.where(share == 1, b, a * (1 - share) + b * share))
    return _between(u), _between(v), values


def _between(x: np.ndarray) -> np.ndarray:
    return np.interp(np.arange((len(x) - 1) * FINE + 1) / FINE, np.arange(len(x)), x)


def _band(
    chart: Chart, u: np.ndarray, v: np.ndarray, values: np.ndarray, low: float, high: float, colour: str, last: bool
) -> Markup:
    """Return all cells of one colour, runs of a row drawn at once."""
    cells = (values[:-1, :-1] + values[1:, :-1] + values[:-1, 1:] + values[1:, 1:]) / 4
    top = np.inf if last else high
    inside = np.isfinite(cells) & (cells >= low) & (cells < top)
    x, y = chart.x(u), chart.y(v)
    pieces = []
    for row, y0, y1 in zip(inside, y[:-1], y[1:], strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        pieces += [f"M{x[a]:.1f} {y0:.1f}H{x[b]:.1f}V{y1:.1f}H{x[a]:.1f}Z" for a, b in edges.reshape(-1, 2)]
    return format_tag("path", d="".join(pieces), style=f"fill:{colour};stroke:{colour};stroke-width:.3")


def _level_line(chart: Chart, u: np.ndarray, v: np.ndarray, values: np.ndarray, level: float) -> str:
    """Return a level's line by marching squares: in every cell the pieces between the sides it crosses."""
    x, y = chart.x(u), chart.y(v)
    above = values - level
    pieces = []
    for i, j in np.argwhere(np.isfinite(values[:-1, :-1] + values[1:, :-1] + values[:-1, 1:] + values[1:, 1:])):
        corner = ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))
        crossed = []
        for (a, b), (c, d) in zip(corner, (*corner[1:], corner[0]), strict=True):
            p, q = above[a, b], above[c, d]
            if (p > 0) != (q > 0):
                share = p / (p - q)
                crossed.append(f"{x[b] + share * (x[d] - x[b]):.1f} {y[a] + share * (y[c] - y[a]):.1f}")
        pieces += [f"M{one}L{other}" for one, other in zip(crossed[::2], crossed[1::2], strict=False)]
    return "".join(pieces)


def _marks(chart: Chart, map_: Map) -> list[Markup]:
    marks = map_.marks.reshape(-1, 2)
    out = []
    for k in np.flatnonzero(_near(marks, map_)):
        x, y = float(chart.x(marks[k, 0])), float(chart.y(marks[k, 1]))
        out.append(format_tag("rect", x=x - 4.5, y=y - 4.5, width=9, height=9, class_="place"))
        if k < len(map_.mark_names):
            out.append(format_tag("text", map_.mark_names[k], x=x + 8, y=y - 6, class_="place-name"))
    return out


def _whole(chart: Chart, map_: Map, content: list[Markup], levels: np.ndarray) -> Markup:
    bottom, right = chart.height - BOTTOM, chart.width + 8
    n, tall = len(levels) - 1, (chart.height - BOTTOM - TOP) / (len(levels) - 1)
    legend = [format_tag("text", map_.unit, x=right, y=12, class_="axis-name")]
    for k, colour in enumerate(_colours(n)):
        legend.append(
            format_tag("rect", x=right, y=bottom - (k + 1) * tall, width=12, height=tall, style=f"fill:{colour}")
        )
        if k:
            legend.append(format_tag("text", f"{levels[k]:.4g}", x=right + 17, y=bottom - k * tall + 3.5))
    inner = chart.render(*content)
    start, end = inner.index(">") + 1, inner.rindex("</svg>")
    return format_tag(
        "svg", Markup(inner[start:end]), *legend, viewBox=f"0 0 {WIDTH} {chart.height}", role="img", class_="chart map"
    )  # noqa: S704
