"""Charts of all figures as SVG: linear or logarithmic axes with units, and the marks of `results.figures` on them.

Every text and attribute is escaped here, once. Colours come from the page's style, by an ink's name, so that a drawing follows
the light or dark theme around it. A `Chart` maps data to a fixed drawing; the page scales it. Maps over a flat section are bands
of colour with level lines between them, as in accuracy and stiffness maps of catalogues.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from tau_dyn import results as r
from tau_dyn.log import find_true_runs


def format_tag(name: str, *content: Markup | str, **attributes: object) -> Markup:
    """Return an element with escaped content; `class_` becomes `class`, `stroke_width` becomes `stroke-width`."""
    pairs = ((key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not None)
    text = "".join(f' {key}="{escape(_short(value))}"' for key, value in pairs)
    inside = Markup("").join(escape(c) for c in content)
    return Markup(f"<{name}{text}>") + inside + Markup(f"</{name}>")


def _short(value: object) -> str:
    return f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)


def draw_svg(title: str, size: tuple[float, float], style: str, *pieces: Markup | str) -> Markup:
    """Return a complete drawing with a width, a height and a title for screen readers."""
    box = f"0 0 {size[0]:.0f} {size[1]:.0f}"
    return format_tag("svg", format_tag("title", title), *pieces, viewBox=box, role="img", class_=style)


def format_path(points: np.ndarray, *, closed: bool = False) -> str:
    """Return a path through points (n, 2) of the drawing."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")


def choose_ticks(low: float, high: float, about: int = 5) -> np.ndarray:
    """Return about `about` round numbers within an interval."""
    raw = (high - low) / max(about, 1)
    if not raw > 0 or not np.isfinite(raw):
        return np.array([low])
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * float(min((1, 2, 2.5, 5, 10), key=lambda m: abs(m * power - raw)))
    return np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step


def choose_log_ticks(low: float, high: float, most: int = 8) -> list[tuple[float, bool]]:
    """Return round numbers in an interval and whether each is labelled: as many of 1, 2, 5 as fit."""
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    every = [m * 10.0**k for k in range(first, last + 1) for m in range(1, 10)]
    inside = [v for v in every if low <= v * (1 + 1e-9) and v <= high * (1 + 1e-9)]
    for wanted in ((1, 2, 3, 4, 5, 6, 7, 8, 9), (1, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        named = [v for v in inside if round(v / 10 ** np.floor(np.log10(v) + 1e-9)) in wanted]
        if len(named) <= most:
            break
    if len(inside) < 3:
        return [(float(v), True) for v in choose_ticks(low, high, about=most)]
    return [(v, v in named) for v in inside]


def choose_power(limits: tuple[float, float]) -> int:
    """Return the power of ten, a multiple of three, by which the labels of an axis are divided; 0 if they are short enough."""
    size = max(abs(x) for x in limits)
    return 0 if not 0 < size < 6e-3 and not 1e5 <= size < np.inf else 3 * int(np.floor(np.log10(size) / 3))


def label(value: float, limits: tuple[float, float]) -> str:
    """Return a tick's label; a value that is zero up to rounding is written as 0."""
    span = limits[1] - limits[0]
    return "0" if abs(value) < 1e-9 * span else f"{value / 10.0 ** choose_power(limits):.5g}".replace("-", "−")


Place = Callable[[np.ndarray], np.ndarray]
"""Function from values of an axis to coordinates of the drawing."""

FINE = 4
"""Subdivisions of the grid's spacing along each axis."""
LEGEND = 66
"""Width of the scale next to a map [px]."""
COLOURS = ("#f3f0dd", "#fbe29a", "#f6bf5f", "#ee9748", "#dd6b44", "#c1434d", "#98285a", "#6a1a5d", "#41114f", "#210a37")
"""Colours from light to dark, so that a map can be printed in grey and read without colour vision."""


def draw_levels(mark: r.Levels, x: Place, y: Place) -> list[Markup]:
    """Return one path for each band of colour and each level line, on a drawing with these axes."""
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
    """Return the scale next to a map, at `right`, from one height of the drawing to another."""
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
    """Return linearly interpolated values between the grid's points; nan next to a missing point."""
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
    """Return all cells of one colour, with neighbours in a row joined."""
    cells = (values[:-1, :-1] + values[1:, :-1] + values[:-1, 1:] + values[1:, 1:]) / 4
    top = np.inf if last else high
    inside = np.isfinite(cells) & (cells >= low) & (cells < top)
    pieces = []
    for row, y0, y1 in zip(inside, y[:-1], y[1:], strict=True):
        runs = find_true_runs(row)
        pieces += [f"M{x[n.start]:.1f} {y0:.1f}H{x[n.stop]:.1f}V{y1:.1f}H{x[n.start]:.1f}Z" for n in runs]
    return format_tag("path", d="".join(pieces), style=f"fill:{colour};stroke:{colour};stroke-width:.3")


def _level_line(x: np.ndarray, y: np.ndarray, values: np.ndarray, level: float) -> str:
    """Return a level's line by marching squares: in every cell the segments between the sides that it crosses."""
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


LEFT, RIGHT, TOP, BOTTOM = 46, 10, 20, 34


@dataclass(frozen=True)
class Chart:
    """A drawing area with data coordinates; limits of a logarithmic axis are in data units and must be positive.

    Attributes:
        width: Total width [px at 100 %].
        height: Total height.
        xlim: Data at the left and right edge.
        ylim: Data at the lower and upper edge.
        title: Title in a corner, also for screen readers.
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

    def draw(self, mark: r.Mark) -> Markup:
        """Return a mark's elements; empty if the mark has no content."""
        match mark:
            case r.Line():
                return self._path(self._line(mark.x, mark.y), mark.ink)
            case r.Dots():
                return self._path(self._dots(mark), mark.ink)
            case r.Strokes():
                ends = zip(
                    _points(self.x(mark.x0), self.y(mark.y0)), _points(self.x(mark.x1), self.y(mark.y1)), strict=True
                )
                return self._path("".join(f"M{start}L{end}" for start, end in ends), mark.ink)
            case r.Ribbon():
                return self._path(self._ribbon(mark), mark.ink)
            case r.Spans():
                return self._path(self._spans(mark), mark.ink)
            case r.Rule():
                return self._path(self._rule(mark), mark.ink)
            case r.Ring():
                ring = np.column_stack([self.x(mark.points[:, 0]), self.y(mark.points[:, 1])])
                return self._path(format_path(ring, closed=True), mark.ink)
            case r.Label():
                place = {"x": float(self.x(mark.x)), "y": float(self.y(mark.y))}
                return format_tag("text", mark.words, **place, class_=mark.ink or None, text_anchor=mark.anchor)
            case r.Cells():
                return Markup("").join(
                    self._path(self._cells(mark, mark.of == k), ink) for k, ink in enumerate(mark.inks)
                )
            case r.Levels():
                return Markup("").join(draw_levels(mark, self.x, self.y))

    def render(self, *marks: r.Mark, style: str = "chart", beside: str = "", wider: int = 0) -> Markup:
        """Return the complete drawing: axes, marks, and further SVG at the right in the additional width `wider`."""
        title = f"{self.title}: {self.ylabel} over {self.xlabel}"
        size = self.width + wider, self.height
        return draw_svg(title, size, style, self._axes(), *map(self.draw, marks), beside)

    def _path(self, d: str, ink: str) -> Markup:
        return format_tag("path", d=d, class_=ink) if d else Markup("")

    def _line(self, x: np.ndarray, y: np.ndarray) -> str:
        there = np.isfinite(y)
        stretches = np.split(np.arange(len(there)), np.flatnonzero(np.diff(there)) + 1) if len(there) else []
        points = _points(self.x(x), self.y(np.where(there, y, self.ylim[0])))
        return "".join("M" + "L".join(points[s[0] : s[-1] + 1]) for s in stretches if there[s[0]])

    def _dots(self, mark: r.Dots) -> str:
        """Return round dots as zero-length strokes with round ends, other shapes as outlines."""
        s = mark.size
        shape = {
            "dot": "h0",
            "ring": f"m{-s:g} 0a{s:g} {s:g} 0 1 0 {2 * s:g} 0a{s:g} {s:g} 0 1 0 {-2 * s:g} 0",
            "cross": f"m{-s:g} {-s:g}l{2 * s:g} {2 * s:g}m{-2 * s:g} 0l{2 * s:g} {-2 * s:g}",
            "plus": f"m{-s:g} 0h{2 * s:g}m{-s:g} {-s:g}v{2 * s:g}",
            "square": f"m{-s:g} {-s:g}h{2 * s:g}v{2 * s:g}h{-2 * s:g}Z",
        }[mark.shape]
        return "".join(f"M{p}{shape}" for p in _points(self.x(mark.x), self.y(mark.y)))

    def _ribbon(self, mark: r.Ribbon) -> str:
        keep = np.isfinite(mark.low) & np.isfinite(mark.high)
        if keep.sum() < 2:
            return ""
        across = self.x(mark.x[keep])
        up, down = (self.y(np.clip(v[keep], *self.ylim)) for v in (mark.high, mark.low))
        ring = np.column_stack([np.concatenate([across, across[::-1]]), np.concatenate([up, down[::-1]])])
        return format_path(ring, closed=True)

    def _spans(self, mark: r.Spans) -> str:
        pieces = []
        for low, high in mark.intervals:
            left, right = (float(v) for v in np.clip(self.x(np.array([low, high])), LEFT, self.width - RIGHT))
            if right > left:
                pieces.append(f"M{left:.1f} {TOP}H{right:.1f}V{self.height - BOTTOM}H{left:.1f}Z")
        return "".join(pieces)

    def _rule(self, mark: r.Rule) -> str:
        if mark.x is not None:
            return f"M{float(self.x(mark.x)):.1f} {TOP}V{self.height - BOTTOM}"
        return f"M{LEFT} {float(self.y(mark.y or 0.0)):.1f}H{self.width - RIGHT}"

    def _cells(self, mark: r.Cells, there: np.ndarray) -> str:
        """Return the cells of a class as one path, rows of neighbours joined."""
        half_u, half_v = (float(x[1] - x[0]) / 2 if len(x) > 1 else 0.005 for x in (mark.u, mark.v))
        pieces = []
        for j in np.flatnonzero(there.any(axis=0) & (mark.v >= self.ylim[0]) & (mark.v <= self.ylim[1])):
            top, bottom = float(self.y(mark.v[j] + half_v)), float(self.y(mark.v[j] - half_v))
            for run in find_true_runs(there[:, j]):
                left = max(float(self.x(mark.u[run.start] - half_u)), float(LEFT))
                right = min(float(self.x(mark.u[run.stop - 1] + half_u)), float(self.width - RIGHT))
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


def draw_figure(figure: r.Figure) -> Markup:
    """Return a figure as SVG; a map of levels has its scale next to it."""
    maps = [mark for mark in figure.marks if isinstance(mark, r.Levels)]
    wider = LEGEND if maps else 0
    (width, height), x, y = figure.size, figure.x, figure.y
    chart = Chart(width - wider, height, x.limits, y.limits, figure.title, x.label, y.label, x.log, y.log)
    scale = draw_scale(chart.width + 8, maps[0].levels, figure.unit, TOP, height - BOTTOM) if maps else []
    style = f"chart {figure.style}".strip()
    return chart.render(*figure.marks, style=style, beside=Markup("").join(scale), wider=wider)


def draw_colour_scale(scale: r.ColourScale) -> Markup:
    """Return a scale of colours with numbers below."""
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
    """Return the relative position of values on an axis, 0 to 1 between its limits."""
    x = np.asarray(value, float)
    if not log:
        return (x - limits[0]) / (limits[1] - limits[0])
    low, high = np.log10(limits)
    return (np.log10(np.maximum(x, 1e-300)) - low) / (high - low)


def _ticks(limits: tuple[float, float], log: bool, about: int, most: int) -> list[tuple[float, str]]:
    """Return an axis' ticks and their labels; a label is empty for a tick with only a line."""
    if log:
        return [(value, f"{value:.5g}" if named else "") for value, named in choose_log_ticks(*limits, most=most)]
    return [(float(value), label(value, limits)) for value in choose_ticks(*limits, about=about)]


def _power_words(limits: tuple[float, float], log: bool) -> str:
    """Return the common factor of an axis' labels; empty if they are short enough."""
    power = 0 if log else choose_power(limits)
    return f" × 10{str(power).translate(_RAISED)}" if power else ""


_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def _points(x: np.ndarray, y: np.ndarray) -> list[str]:
    return [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]
