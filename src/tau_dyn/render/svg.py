"""Elements, paths and round numbers of a vector drawing; every text and attribute is escaped here, once."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup, escape


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


def choose_log_ticks(low: float, high: float, most: int = 8) -> list[tuple[float, bool]]:
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


def choose_power(limits: tuple[float, float]) -> int:
    """Return the power of ten, in threes, that is left out of an axis' numbers; 0 where they are short as they are."""
    size = max(abs(x) for x in limits)
    return 0 if not 0 < size < 6e-3 and not 1e5 <= size < np.inf else 3 * int(np.floor(np.log10(size) / 3))


def label(value: float, limits: tuple[float, float]) -> str:
    """Return a tick's number; what is zero up to rounding is zero."""
    span = limits[1] - limits[0]
    return "0" if abs(value) < 1e-9 * span else f"{value / 10.0 ** choose_power(limits):.5g}".replace("-", "−")
