"""One chart module for every figure: axes with units, linear or logarithmic, and marks of `results.figures` on them, as SVG.

Every text and attribute is escaped here, once. Colours come from the page's style, by an ink's name, so that a drawing is light
or dark with what surrounds it. A `Chart` maps data to a fixed drawing; the page scales it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from tau_dyn.render.levels import LEGEND, draw_levels, draw_scale
from tau_dyn.render.svg import choose_log_ticks, choose_power, choose_ticks, format_path, format_tag, label
from tau_dyn.results import (
    Cells,
    ColourScale,
    Dots,
    Figure,
    Label,
    Levels,
    Line,
    Mark,
    Ribbon,
    Ring,
    Rule,
    Spans,
    Strokes,
)

LEFT, RIGHT, TOP, BOTTOM = 46, 10, 20, 34


@dataclass(frozen=True)
class Chart:
    """A drawing area with data coordinates; limits of a logarithmic axis stay in data units and have to be positive.

    Attributes:
        width: Whole width [px at 100 %].
        height: Whole height.
        xlim: Data at the left and right edge.
        ylim: Data at the lower and upper edge.
        title: What is drawn, in a corner; also read out by screen readers.
        xlabel: Quantity and unit of the horizontal axis.
        ylabel: Quantity and unit of the vertical axis, written above it.
        log_x: Whether the horizontal axis is logarithmic.
        log_y: Whether the vertical axis is.
    """

    width: int
    height: int
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    title: str
    xlabel: str
    ylabel: str
    log_x: bool = False
    log_y: bool = False

    def x(self, value: np.ndarray | float) -> np.ndarray:
        """Return horizontal drawing coordinates."""
        return LEFT + _share(value, self.xlim, self.log_x) * (self.width - LEFT - RIGHT)

    def y(self, value: np.ndarray | float) -> np.ndarray:
        """Return vertical drawing coordinates."""
        return self.height - BOTTOM - _share(value, self.ylim, self.log_y) * (self.height - TOP - BOTTOM)

    def draw(self, mark: Mark) -> Markup:
        """Return a mark's elements, or nothing where it shows nothing."""
        match mark:
            case Line():
                return self._path(self._line(mark.x, mark.y), mark.ink)
            case Dots():
                return self._path(self._dots(mark), mark.ink)
            case Strokes():
                ends = zip(
                    _points(self.x(mark.x0), self.y(mark.y0)), _points(self.x(mark.x1), self.y(mark.y1)), strict=True
                )
                return self._path("".join(f"M{start}L{end}" for start, end in ends), mark.ink)
            case Ribbon():
                return self._path(self._ribbon(mark), mark.ink)
            case Spans():
                return self._path(self._spans(mark), mark.ink)
            case Rule():
                return self._path(self._rule(mark), mark.ink)
            case Ring():
                ring = np.column_stack([self.x(mark.points[:, 0]), self.y(mark.points[:, 1])])
                return self._path(format_path(ring, closed=True), mark.ink)
            case Label():
                place = {"x": float(self.x(mark.x)), "y": float(self.y(mark.y))}
                return format_tag("text", mark.words, **place, class_=mark.ink or None, text_anchor=mark.anchor)
            case Cells():
                return Markup("").join(
                    self._path(self._cells(mark, mark.of == k), ink) for k, ink in enumerate(mark.inks)
                )
            case Levels():
                return Markup("").join(draw_levels(mark, self.x, self.y))

    def render(self, *marks: Mark, style: str = "chart", beside: str = "", wider: int = 0) -> Markup:
        """Return the whole drawing: axes behind, marks within, and what stands beside it in so much more width."""
        return format_tag(
            "svg", format_tag("title", f"{self.title}: {self.ylabel} over {self.xlabel}"), self._axes(), *map(self.draw, marks),
            beside, viewBox=f"0 0 {self.width + wider} {self.height}", role="img", class_=style,
        )  # fmt: skip

    def _path(self, d: str, ink: str) -> Markup:
        return format_tag("path", d=d, class_=ink) if d else Markup("")

    def _line(self, x: np.ndarray, y: np.ndarray) -> str:
        there = np.isfinite(y)
        stretches = np.split(np.arange(len(there)), np.flatnonzero(np.diff(there)) + 1) if len(there) else []
        points = _points(self.x(x), self.y(np.where(there, y, self.ylim[0])))
        return "".join("M" + "L".join(points[s[0] : s[-1] + 1]) for s in stretches if there[s[0]])

    def _dots(self, mark: Dots) -> str:
        """Return round dots as zero-length strokes with round ends, others as outlines."""
        s = mark.size
        shape = {
            "dot": "h0",
            "ring": f"m{-s:g} 0a{s:g} {s:g} 0 1 0 {2 * s:g} 0a{s:g} {s:g} 0 1 0 {-2 * s:g} 0",
            "cross": f"m{-s:g} {-s:g}l{2 * s:g} {2 * s:g}m{-2 * s:g} 0l{2 * s:g} {-2 * s:g}",
            "plus": f"m{-s:g} 0h{2 * s:g}m{-s:g} {-s:g}v{2 * s:g}",
            "square": f"m{-s:g} {-s:g}h{2 * s:g}v{2 * s:g}h{-2 * s:g}Z",
        }[mark.shape]
        return "".join(f"M{p}{shape}" for p in _points(self.x(mark.x), self.y(mark.y)))

    def _ribbon(self, mark: Ribbon) -> str:
        keep = np.isfinite(mark.low) & np.isfinite(mark.high)
        if keep.sum() < 2:
            return ""
        across = self.x(mark.x[keep])
        up, down = (self.y(np.clip(v[keep], *self.ylim)) for v in (mark.high, mark.low))
        ring = np.column_stack([np.concatenate([across, across[::-1]]), np.concatenate([up, down[::-1]])])
        return format_path(ring, closed=True)

    def _spans(self, mark: Spans) -> str:
        pieces = []
        for low, high in mark.intervals:
            left, right = (float(v) for v in np.clip(self.x(np.array([low, high])), LEFT, self.width - RIGHT))
            if right > left:
                pieces.append(f"M{left:.1f} {TOP}H{right:.1f}V{self.height - BOTTOM}H{left:.1f}Z")
        return "".join(pieces)

    def _rule(self, mark: Rule) -> str:
        if mark.x is not None:
            return f"M{float(self.x(mark.x)):.1f} {TOP}V{self.height - BOTTOM}"
        return f"M{LEFT} {float(self.y(mark.y or 0.0)):.1f}H{self.width - RIGHT}"

    def _cells(self, mark: Cells, there: np.ndarray) -> str:
        """Return the cells of a class as one path, rows of neighbours joined."""
        half_u, half_v = (float(x[1] - x[0]) / 2 if len(x) > 1 else 0.005 for x in (mark.u, mark.v))
        pieces = []
        for j in np.flatnonzero(there.any(axis=0) & (mark.v >= self.ylim[0]) & (mark.v <= self.ylim[1])):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], there[:, j].astype(int), [0]])))
            top, bottom = float(self.y(mark.v[j] + half_v)), float(self.y(mark.v[j] - half_v))
            for start, end in zip(edges[::2], edges[1::2] - 1, strict=True):
                left = max(float(self.x(mark.u[start] - half_u)), float(LEFT))
                right = min(float(self.x(mark.u[end] + half_u)), float(self.width - RIGHT))
                if right > left:
                    pieces.append(f"M{left:.1f} {top:.1f}H{right:.1f}V{bottom + 0.15:.1f}H{left:.1f}Z")
        return "".join(pieces)

    def _axes(self) -> Markup:
        right = self.width - RIGHT
        x_power, y_power = _power_words(self.xlim, self.log_x), _power_words(self.ylim, self.log_y)
        pieces = [
            format_tag("text", self.title, x=right, y=12, text_anchor="end", class_="name"),
            format_tag("text", f"{self.ylabel}{y_power}", x=LEFT - 40, y=12, class_="axis-name"),
            format_tag(
                "text", f"{self.xlabel}{x_power}", x=right, y=self.height - 3, text_anchor="end", class_="axis-name"
            ),
        ]
        bottom = self.height - BOTTOM
        for value, name in _ticks(self.xlim, self.log_x, max(3, self.width // 110), max(3, self.width // 70)):
            at = float(self.x(value))
            pieces.append(format_tag("path", d=f"M{at:.1f} {TOP}V{bottom}", class_="grid"))
            pieces += [format_tag("text", name, x=at, y=bottom + 14, text_anchor="middle")] if name else []
        for value, name in _ticks(self.ylim, self.log_y, max(2, self.height // 45), max(3, self.height // 40)):
            at = float(self.y(value))
            ink = "zero" if value == 0 and not self.log_y else "grid"
            pieces.append(format_tag("path", d=f"M{LEFT} {at:.1f}H{right}", class_=ink))
            pieces += [format_tag("text", name, x=LEFT - 6, y=at + 3.5, text_anchor="end")] if name else []
        return Markup("").join(pieces)


def draw_figure(figure: Figure) -> Markup:
    """Return a figure as SVG; beside a map of levels stands their scale."""
    maps = [mark for mark in figure.marks if isinstance(mark, Levels)]
    wider = LEGEND if maps else 0
    (width, height), x, y = figure.size, figure.x, figure.y
    chart = Chart(width - wider, height, x.limits, y.limits, figure.title, x.label, y.label, x.log, y.log)
    scale = draw_scale(chart.width + 8, maps[0].levels, figure.unit, TOP, height - BOTTOM) if maps else []
    style = f"chart {figure.style}".strip()
    return chart.render(*figure.marks, style=style, beside=Markup("").join(scale), wider=wider)


def draw_colour_scale(scale: ColourScale) -> Markup:
    """Return a scale of colours with its numbers below."""
    wide, n = 15.0, len(scale.inks)
    pieces = [
        format_tag("rect", x=4 + k * wide, y=2, width=wide + 0.5, height=11, class_=ink)
        for k, ink in enumerate(scale.inks)
    ]
    last = len(scale.numbers) - 1
    for k, number in enumerate(scale.numbers):
        anchor = "start" if k == 0 else "end" if k == last else "middle"
        pieces.append(format_tag("text", number, x=4 + k / last * n * wide, y=26, text_anchor=anchor))
    size = int(8 + n * wide)
    return format_tag("svg", *pieces, viewBox=f"0 0 {size} 30", width=size, height=30, class_="scale", role="img")


def _share(value: np.ndarray | float, limits: tuple[float, float], log: bool) -> np.ndarray:
    """Return how far along an axis values lie, 0 to 1 between its limits."""
    x = np.asarray(value, float)
    if not log:
        return (x - limits[0]) / (limits[1] - limits[0])
    low, high = np.log10(limits)
    return (np.log10(np.maximum(x, 1e-300)) - low) / (high - low)


def _ticks(limits: tuple[float, float], log: bool, about: int, most: int) -> list[tuple[float, str]]:
    """Return an axis' round numbers and how each is written, empty for those that only a line shows."""
    if log:
        return [(value, f"{value:.5g}" if named else "") for value, named in choose_log_ticks(*limits, most=most)]
    return [(float(value), label(value, limits)) for value in choose_ticks(*limits, about=about)]


def _power_words(limits: tuple[float, float], log: bool) -> str:
    """Return what an axis' numbers are to be multiplied by, where they would be too long otherwise."""
    power = 0 if log else choose_power(limits)
    return f" × 10{str(power).translate(_RAISED)}" if power else ""


_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def _points(x: np.ndarray, y: np.ndarray) -> list[str]:
    return [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]
