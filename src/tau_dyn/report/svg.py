"""Small vector charts without a plotting library: axes with units, lines, dots, bands. Colours come from the page's style.

Every text and attribute is escaped here, once. A `Chart` maps data to a fixed drawing; the page scales it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

LEFT, RIGHT, TOP, BOTTOM = 46, 10, 20, 34
THIRD, HALF, WHOLE = 344, 520, 1060
"""Widths of drawings that stand three or two in a row of a card, or alone [px]."""


def format_tag(name: str, *content: Markup | str, **attributes: object) -> Markup:
    """Return an element; `class_` and `stroke_width` lose and change their underscore, content is escaped."""
    pairs = ((key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not None)
    text = "".join(f' {key}="{escape(_short(value))}"' for key, value in pairs)
    inside = Markup("").join(escape(c) for c in content)
    return Markup(f"<{name}{text}>") + inside + Markup(f"</{name}>")


def _short(value: object) -> str:
    return f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)


def format_path(points: np.ndarray, *, closed: bool = False) -> str:
    """Return a path through points (n, 2) of the drawing."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")


def choose_ticks(low: float, high: float, about: int = 5) -> np.ndarray:
    """Return round numbers within an interval, about so many."""
    raw = (high - low) / max(about, 1)
    if not raw > 0 or not np.isfinite(raw):
        return np.array([low])
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * float(min((1, 2, 2.5, 5, 10), key=lambda m: abs(m * power - raw)))
    return np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step


@dataclass(frozen=True)
class Chart:
    """A drawing area with data coordinates.

    Attributes:
        width: Whole width [px at 100 %].
        height: Whole height.
        xlim: Data at the left and right edge.
        ylim: Data at the lower and upper edge.
        title: What is drawn, in a corner; also read out by screen readers.
        xlabel: Quantity and unit of the horizontal axis.
        ylabel: Quantity and unit of the vertical axis, written above it.
    """

    width: int
    height: int
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    title: str
    xlabel: str
    ylabel: str

    def x(self, value: np.ndarray | float) -> np.ndarray:
        """Return horizontal drawing coordinates."""
        low, high = self.xlim
        return LEFT + (np.asarray(value, float) - low) / (high - low) * (self.width - LEFT - RIGHT)

    def y(self, value: np.ndarray | float) -> np.ndarray:
        """Return vertical drawing coordinates."""
        low, high = self.ylim
        return self.height - BOTTOM - (np.asarray(value, float) - low) / (high - low) * (self.height - TOP - BOTTOM)

    def line(self, x: np.ndarray, y: np.ndarray, class_: str) -> Markup:
        """Return a polyline, broken where a value is missing."""
        there = np.isfinite(y)
        stretches = np.split(np.arange(len(there)), np.flatnonzero(np.diff(there)) + 1) if len(there) else []
        points = _points(self.x(x), self.y(np.where(there, y, 0.0)))
        drawn = ["M" + "L".join(points[s[0] : s[-1] + 1]) for s in stretches if there[s[0]]]
        return format_tag("path", d="".join(drawn), class_=class_) if drawn else Markup("")

    def dots(self, x: np.ndarray, y: np.ndarray, class_: str) -> Markup:
        """Return many dots as one path of zero-length strokes with round ends."""
        points = _points(self.x(x), self.y(y))
        return format_tag("path", d="".join(f"M{p}h0" for p in points), class_=class_)

    def verticals(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, class_: str) -> Markup:
        """Return vertical strokes, such as error bars."""
        ends = zip(_points(self.x(x), self.y(low)), self.y(high), strict=True)
        return format_tag("path", d="".join(f"M{p}V{top:.1f}" for p, top in ends), class_=class_)

    def band(self, intervals: Iterable[tuple[float, float]], class_: str) -> Markup:
        """Return shaded stretches of the horizontal axis, full height."""
        pieces = []
        for low, high in intervals:
            left, right = (float(v) for v in np.clip(self.x(np.array([low, high])), LEFT, self.width - RIGHT))
            if right > left:
                pieces.append(f"M{left:.1f} {TOP}H{right:.1f}V{self.height - BOTTOM}H{left:.1f}Z")
        return format_tag("path", d="".join(pieces), class_=class_) if pieces else Markup("")

    def text(self, x: float, y: float, content: str, class_: str = "", anchor: str = "start") -> Markup:
        """Return text at data coordinates."""
        return format_tag(
            "text", content, x=float(self.x(x)), y=float(self.y(y)), class_=class_ or None, text_anchor=anchor
        )

    def render(self, *content: Markup) -> Markup:
        """Return the whole drawing: axes behind, content within."""
        inner = Markup("").join(content)
        return format_tag(
            "svg", format_tag("title", f"{self.title}: {self.ylabel} over {self.xlabel}"), self._axes(), inner,
            viewBox=f"0 0 {self.width} {self.height}", role="img", class_="chart",
        )  # fmt: skip

    def _axes(self) -> Markup:
        right = self.width - RIGHT
        pieces = [
            format_tag("text", self.title, x=right, y=12, text_anchor="end", class_="name"),
            format_tag("text", f"{self.ylabel}{self._power_words(self.ylim)}", x=LEFT - 40, y=12, class_="axis-name"),
            format_tag("text", f"{self.xlabel}{self._power_words(self.xlim)}", x=right, y=self.height - 3, text_anchor="end",
                class_="axis-name"),
        ]  # fmt: skip
        return Markup("").join([*pieces, *self._columns(self.height - BOTTOM), *self._levels(right)])

    def _columns(self, bottom: int) -> list[Markup]:
        """Return the vertical lines and what they are called."""
        pieces = []
        for value in choose_ticks(*self.xlim, about=max(3, self.width // 110)):
            at = float(self.x(value))
            pieces.append(format_tag("path", d=f"M{at:.1f} {TOP}V{bottom}", class_="grid"))
            pieces.append(format_tag("text", label(value, self.xlim), x=at, y=bottom + 14, text_anchor="middle"))
        return pieces

    def _levels(self, right: int) -> list[Markup]:
        """Return the horizontal lines and what they are called."""
        pieces = []
        for value in choose_ticks(*self.ylim, about=max(2, self.height // 45)):
            at = float(self.y(value))
            pieces.append(format_tag("path", d=f"M{LEFT} {at:.1f}H{right}", class_="zero" if value == 0 else "grid"))
            pieces.append(format_tag("text", label(value, self.ylim), x=LEFT - 6, y=at + 3.5, text_anchor="end"))
        return pieces

    def _power_words(self, limits: tuple[float, float]) -> str:
        """Return what an axis' numbers are to be multiplied by, where they would be too long otherwise."""
        power = choose_power(limits)
        return f" × 10{str(power).translate(_RAISED)}" if power else ""


_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def choose_power(limits: tuple[float, float]) -> int:
    """Return the power of ten, in threes, that is left out of an axis' numbers; 0 where they are short as they are."""
    size = max(abs(x) for x in limits)
    return 0 if not 0 < size < 6e-3 and not 1e5 <= size < np.inf else 3 * int(np.floor(np.log10(size) / 3))


def label(value: float, limits: tuple[float, float]) -> str:
    """Return a tick's number; what is zero up to rounding is zero."""
    span = limits[1] - limits[0]
    return "0" if abs(value) < 1e-9 * span else f"{value / 10.0 ** choose_power(limits):.5g}".replace("-", "−")


def pad_limits(*arrays: np.ndarray, share: float = 0.06) -> tuple[float, float]:
    """Return limits that hold all values with some air."""
    values = np.concatenate([np.ravel(a) for a in arrays])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    air = share * (high - low) or share * abs(high) or 1.0
    return low - air, high + air


def _points(x: np.ndarray, y: np.ndarray) -> list[str]:
    return [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]
