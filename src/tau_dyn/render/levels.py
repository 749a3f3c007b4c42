"""Maps over a flat section: bands of colour with level lines, as a catalogue prints an accuracy or stiffness map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from markupsafe import Markup

from tau_dyn.render.svg import format_tag
from tau_dyn.results import Levels

Place = Callable[[np.ndarray], np.ndarray]
"""Where values of an axis lie on the drawing."""

FINE = 4
"""Points drawn between two of the grid, to a side."""
LEGEND = 66
"""Width of the scale beside a map [px]."""
COLOURS = ("#f3f0dd", "#fbe29a", "#f6bf5f", "#ee9748", "#dd6b44", "#c1434d", "#98285a", "#6a1a5d", "#41114f", "#210a37")
"""From light to dark, so that it prints in grey and reads without colour vision."""


def draw_levels(mark: Levels, x: Place, y: Place) -> list[Markup]:
    """Return one path a band of colour, one a level line, on a drawing with these axes."""
    u, v, values = _refined(mark.u, mark.v, mark.values)
    across, up = x(u), y(v)
    levels = mark.levels
    bands = [_band(across, up, values, low, high, colour, high == levels[-1])
             for low, high, colour in zip(levels[:-1], levels[1:], _colours(len(levels) - 1), strict=True)]  # fmt: skip
    return [
        *bands,
        *(format_tag("path", d=_level_line(across, up, values, level), class_="level") for level in levels[1:-1]),
    ]


def draw_scale(right: float, levels: np.ndarray, unit: str, top: float, bottom: float) -> list[Markup]:
    """Return the scale beside a map, at `right`, from one height of the drawing to another."""
    n = len(levels) - 1
    tall = (bottom - top) / n
    pieces = [format_tag("text", unit, x=right, y=12, class_="axis-name")]
    for k, colour in enumerate(_colours(n)):
        pieces.append(
            format_tag("rect", x=right, y=bottom - (k + 1) * tall, width=12, height=tall, style=f"fill:{colour}")
        )
        if k:
            pieces.append(format_tag("text", f"{levels[k]:.4g}", x=right + 17, y=bottom - k * tall + 3.5))
    return pieces


def _colours(n: int) -> list[str]:
    return [COLOURS[round(k * (len(COLOURS) - 1) / max(n - 1, 1))] for k in range(n)]


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


def _band(x: np.ndarray, y: np.ndarray, values: np.ndarray, low: float, high: float, colour: str, last: bool) -> Markup:
    """Return all cells of one colour, runs of a row drawn at once."""
    cells = (values[:-1, :-1] + values[1:, :-1] + values[:-1, 1:] + values[1:, 1:]) / 4
    top = np.inf if last else high
    inside = np.isfinite(cells) & (cells >= low) & (cells < top)
    pieces = []
    for row, y0, y1 in zip(inside, y[:-1], y[1:], strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        pieces += [f"M{x[a]:.1f} {y0:.1f}H{x[b]:.1f}V{y1:.1f}H{x[a]:.1f}Z" for a, b in edges.reshape(-1, 2)]
    return format_tag("path", d="".join(pieces), style=f"fill:{colour};stroke:{colour};stroke-width:.3")


def _level_line(x: np.ndarray, y: np.ndarray, values: np.ndarray, level: float) -> str:
    """Return a level's line by marching squares: in every cell the pieces between the sides it crosses."""
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
