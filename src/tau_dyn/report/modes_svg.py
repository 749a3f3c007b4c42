"""What the page of resonances draws beyond plain charts: bands between curves, ellipses, marks, lines across."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from tau_dyn.report.svg import BOTTOM, LEFT, RIGHT, TOP, Chart, format_path, format_tag

CHI2_95 = 5.991
"""Quantile of chi-squared with two degrees of freedom: an ellipse of 95 %."""


def draw_between(chart: Chart, x: np.ndarray, low: np.ndarray, high: np.ndarray, class_: str) -> Markup:
    """Return the area between two curves, within the chart."""
    keep = np.isfinite(low) & np.isfinite(high)
    if keep.sum() < 2:
        return Markup("")
    across = chart.x(x[keep])
    up, down = (chart.y(np.clip(v[keep], *chart.ylim)) for v in (high, low))
    ring = np.column_stack([np.concatenate([across, across[::-1]]), np.concatenate([up, down[::-1]])])
    return format_tag("path", d=format_path(ring, closed=True), class_=class_)


def draw_ellipse(chart: Chart, centre: tuple[float, float], covariance: np.ndarray, class_: str) -> Markup:
    """Return the 95 % ellipse of a point with a covariance (2, 2), both in data units."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.sqrt(CHI2_95 * np.maximum(values, 0))[:, None] * np.array([np.cos(angle), np.sin(angle)])
    x, y = np.array(centre)[:, None] + vectors @ ring
    return format_tag("path", d=format_path(np.column_stack([chart.x(x), chart.y(y)]), closed=True), class_=class_)


def draw_across(chart: Chart, value: float, class_: str) -> Markup:
    """Return a vertical line through the whole chart at a horizontal value."""
    at = float(chart.x(value))
    return format_tag("path", d=f"M{at:.1f} {TOP}V{chart.height - BOTTOM}", class_=class_)


def draw_along(chart: Chart, value: float, class_: str) -> Markup:
    """Return a horizontal line through the whole chart."""
    at = float(chart.y(value))
    return format_tag("path", d=f"M{LEFT} {at:.1f}H{chart.width - RIGHT}", class_=class_)


def draw_marks(chart: Chart, x: np.ndarray, y: np.ndarray, shape: str, class_: str, size: float = 4.0) -> Markup:
    """Return one path of marks: `cross` or `ring`."""
    out = []
    for a, b in zip(chart.x(x), chart.y(y), strict=True):
        if shape == "cross":
            out.append(
                f"M{a - size:.1f} {b - size:.1f}L{a + size:.1f} {b + size:.1f}"
                f"M{a - size:.1f} {b + size:.1f}L{a + size:.1f} {b - size:.1f}"
            )
        else:
            out.append(f"M{a - size:.1f} {b:.1f}a{size} {size} 0 1 0 {2 * size} 0a{size} {size} 0 1 0 {-2 * size} 0")
    return format_tag("path", d="".join(out), class_=class_) if out else Markup("")
