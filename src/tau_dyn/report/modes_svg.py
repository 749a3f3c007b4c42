"""What the page of resonances draws beyond plain charts: logarithmic frequency axes, bands between curves, ellipses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from tau_dyn.report.svg import BOTTOM, LEFT, RIGHT, TOP, Chart, label, tag, ticks

CHI2_95 = 5.991
"""Quantile of chi-squared with two degrees of freedom: an ellipse of 95 %."""


@dataclass(frozen=True)
class LogChart(Chart):
    """A chart whose horizontal axis is logarithmic; `xlim` stays in data units and has to be positive."""

    def x(self, value: np.ndarray | float) -> np.ndarray:
        """Return horizontal drawing coordinates."""
        low, high = np.log10(self.xlim)
        at = np.log10(np.maximum(np.asarray(value, float), 1e-300))
        return LEFT + (at - low) / (high - low) * (self.width - LEFT - RIGHT)

    def _axes(self) -> Markup:
        bottom, right = self.height - BOTTOM, self.width - RIGHT
        pieces = [
            tag("text", self.title, x=right, y=12, text_anchor="end", class_="name"),
            tag("text", self.ylabel, x=LEFT - 40, y=12, class_="axis-name"),
            tag("text", self.xlabel, x=right, y=self.height - 3, text_anchor="end", class_="axis-name"),
        ]
        for value, named in log_ticks(*self.xlim, most=max(3, self.width // 70)):
            at = float(self.x(value))
            pieces.append(tag("path", d=f"M{at:.1f} {TOP}V{bottom}", class_="grid"))
            if named:
                pieces.append(tag("text", f"{value:.5g}", x=at, y=bottom + 14, text_anchor="middle"))
        for value in ticks(*self.ylim, about=max(2, self.height // 45)):
            at = float(self.y(value))
            pieces.append(tag("path", d=f"M{LEFT} {at:.1f}H{right}", class_="zero" if value == 0 else "grid"))
            pieces.append(tag("text", label(value, self.ylim), x=LEFT - 6, y=at + 3.5, text_anchor="end"))
        return Markup("").join(pieces)


def log_ticks(low: float, high: float, most: int = 8) -> list[tuple[float, bool]]:
    """Return round numbers in an interval and whether each is written out: as many of 1, 2, 5 as there is room for."""
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    every = [m * 10.0**k for k in range(first, last + 1) for m in range(1, 10)]
    inside = [v for v in every if low <= v * (1 + 1e-9) and v <= high * (1 + 1e-9)]
    for wanted in ((1, 2, 3, 4, 5, 6, 7, 8, 9), (1, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        named = [v for v in inside if round(v / 10 ** np.floor(np.log10(v) + 1e-9)) in wanted]
        if len(named) <= most:
            break
    if len(inside) < 3:
        return [(float(v), True) for v in ticks(low, high, about=most)]
    return [(v, v in named) for v in inside]


def between(chart: Chart, x: np.ndarray, low: np.ndarray, high: np.ndarray, class_: str) -> Markup:
    """Return the area between two curves, within the chart."""
    keep = np.isfinite(low) & np.isfinite(high)
    if keep.sum() < 2:
        return Markup("")
    across = chart.x(x[keep])
    up, down = (chart.y(np.clip(v[keep], *chart.ylim)) for v in (high, low))
    there = [f"{a:.1f} {b:.1f}" for a, b in zip(across, up, strict=True)]
    back = [f"{a:.1f} {b:.1f}" for a, b in zip(across[::-1], down[::-1], strict=True)]
    return tag("path", d="M" + "L".join([*there, *back]) + "Z", class_=class_)


def ellipse(chart: Chart, centre: tuple[float, float], covariance: np.ndarray, class_: str) -> Markup:
    """Return the 95 % ellipse of a point with a covariance (2, 2), both in data units."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.sqrt(CHI2_95 * np.maximum(values, 0))[:, None] * np.array([np.cos(angle), np.sin(angle)])
    x, y = np.array(centre)[:, None] + vectors @ ring
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(chart.x(x), chart.y(y), strict=True)]
    return tag("path", d="M" + "L".join(points) + "Z", class_=class_)


def across(chart: Chart, value: float, class_: str) -> Markup:
    """Return a vertical line through the whole chart at a horizontal value."""
    at = float(chart.x(value))
    return tag("path", d=f"M{at:.1f} {TOP}V{chart.height - BOTTOM}", class_=class_)


def along(chart: Chart, value: float, class_: str) -> Markup:
    """Return a horizontal line through the whole chart."""
    at = float(chart.y(value))
    return tag("path", d=f"M{LEFT} {at:.1f}H{chart.width - RIGHT}", class_=class_)


def marks(chart: Chart, x: np.ndarray, y: np.ndarray, shape: str, class_: str, size: float = 4.0) -> Markup:
    """Return one path of marks: `cross`, `ring` or `plus`."""
    out = []
    for a, b in zip(chart.x(x), chart.y(y), strict=True):
        if shape == "cross":
            out.append(
                f"M{a - size:.1f} {b - size:.1f}L{a + size:.1f} {b + size:.1f}"
                f"M{a - size:.1f} {b + size:.1f}L{a + size:.1f} {b - size:.1f}"
            )
        elif shape == "plus":
            out.append(f"M{a - size:.1f} {b:.1f}H{a + size:.1f}M{a:.1f} {b - size:.1f}V{b + size:.1f}")
        else:
            out.append(f"M{a - size:.1f} {b:.1f}a{size} {size} 0 1 0 {2 * size} 0a{size} {size} 0 1 0 {-2 * size} 0")
    return tag("path", d="".join(out), class_=class_) if out else Markup("")
