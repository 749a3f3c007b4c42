"""Charts with a logarithmic axis, or two; limits stay in data units and have to be positive there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from tau_dyn.report.svg import BOTTOM, LEFT, RIGHT, TOP, Chart, choose_ticks, format_tag


@dataclass(frozen=True)
class LogChart(Chart):
    """A chart whose axes are logarithmic as said: along frequencies by default.

    Attributes:
        log_x: Whether the horizontal one is.
        log_y: Whether the vertical one is.
    """

    log_x: bool = True
    log_y: bool = False

    def x(self, value: np.ndarray | float) -> np.ndarray:
        """Return horizontal drawing coordinates."""
        return LEFT + _share(value, self.xlim) * (self.width - LEFT - RIGHT) if self.log_x else super().x(value)

    def y(self, value: np.ndarray | float) -> np.ndarray:
        """Return vertical drawing coordinates."""
        if not self.log_y:
            return super().y(value)
        return self.height - BOTTOM - _share(value, self.ylim) * (self.height - TOP - BOTTOM)

    def _columns(self, bottom: int) -> list[Markup]:
        if not self.log_x:
            return super()._columns(bottom)
        pieces = []
        for value, named in log_ticks(*self.xlim, most=max(3, self.width // 70)):
            at = float(self.x(value))
            pieces.append(format_tag("path", d=f"M{at:.1f} {TOP}V{bottom}", class_="grid"))
            if named:
                pieces.append(format_tag("text", f"{value:.5g}", x=at, y=bottom + 14, text_anchor="middle"))
        return pieces

    def _levels(self, right: int) -> list[Markup]:
        if not self.log_y:
            return super()._levels(right)
        pieces = []
        for value, named in log_ticks(*self.ylim, most=max(3, self.height // 40)):
            at = float(self.y(value))
            pieces.append(format_tag("path", d=f"M{LEFT} {at:.1f}H{right}", class_="grid"))
            if named:
                pieces.append(format_tag("text", f"{value:.4g}", x=LEFT - 6, y=at + 3.5, text_anchor="end"))
        return pieces

    def _power_words(self, limits: tuple[float, float]) -> str:
        log = (self.log_x and limits is self.xlim) or (self.log_y and limits is self.ylim)
        return "" if log else super()._power_words(limits)


def _share(value: np.ndarray | float, limits: tuple[float, float]) -> np.ndarray:
    """Return how far along a logarithmic axis values lie, 0 to 1 between its limits."""
    low, high = np.log10(limits)
    return (np.log10(np.maximum(np.asarray(value, float), 1e-300)) - low) / (high - low)


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
        return [(float(v), True) for v in choose_ticks(low, high, about=most)]
    return [(v, v in named) for v in inside]
