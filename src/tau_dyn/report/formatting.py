"""How every result is said: numbers with their uncertainty, units, lists, and how far something may be used.

`±` is a standard error (`95.14 ± 0.20 kg`); minus signs are true ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import floor, isfinite, log10
from typing import Literal, NamedTuple

Z95 = 1.959964  # two-sided 95 % point of the normal distribution
_MAX_STDERR = 1e300
"""A standard error beyond this has no decimals that a float could say."""
Level = Literal["good", "care", "poor"]


class UseRecommendation(NamedTuple):
    """How far a result may be used, in one word and one sentence."""

    level: Level
    sentence: str


def format_recommendation(level: Level) -> str:
    """Return a verdict in a word or three."""
    return {"good": "Ready to use", "care": "Use with care", "poor": "Not usable"}[level]


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits and a true minus sign."""
    text = f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return replace_minus_signs(text if not _tiny_or_huge(value) else f"{value:.{digits - 1}e}")


def format_limit(limit: float, digits: int = 3) -> str:
    """Return a limit as a number; `none` where there is none."""
    return format_number(limit, digits) if isfinite(limit) else "none"


def format_fixed_digits(value: float) -> str:
    """Return a number with three significant digits, zeros at its end kept, so that a column reads evenly."""
    return (
        format_number(value, 3)
        if _tiny_or_huge(value) or not value
        else replace_minus_signs(f"{value:#.3g}".rstrip("."))
    )


def format_percent(value: float) -> str:
    """Return a percentage with two significant digits, such as `3.0 %`."""
    if not isfinite(value):
        return "more than 100 %"
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.1f} %" if value >= 0.995 else f"{value:.2g} %"


def choose_decimals(stderr: float) -> int:
    """Return how many decimals show two significant digits of an uncertainty; negative above 100."""
    if not 0 < stderr < _MAX_STDERR:
        return 3
    decimals = 1 - floor(log10(stderr))
    return decimals - 1 if round(stderr, decimals) >= 10.0 ** (2 - decimals) else decimals


def round_to_stderr(value: float, stderr: float) -> str:
    """Return a value to the digits that its uncertainty leaves."""
    decimals = choose_decimals(stderr)
    if decimals > 7 or _tiny_or_huge(max(abs(value), stderr)):
        return format_number(value)
    shown = round(value, decimals)
    return replace_minus_signs(f"{shown if shown else 0.0:.{max(decimals, 0)}f}")


def format_with_uncertainty(value: float, stderr: float | None, unit: str = "") -> str:
    """Return `95.14 ± 0.20 kg`: two digits of the standard error, the value to the same decimal."""
    tail = f" {format_unit(unit)}" if unit else ""
    if stderr is None or not stderr > 0:
        return format_number(value) + tail
    decimals = choose_decimals(stderr)
    if decimals > 7 or _tiny_or_huge(max(abs(value), stderr)):
        return f"{round_to_stderr(value, stderr)} ± {round_to_stderr(stderr, stderr)}{tail}"
    return f"{round_to_stderr(value, stderr)} ± {round(stderr, decimals):.{max(decimals, 0)}f}{tail}"


def format_unit(unit: str) -> str:
    """Return a unit with raised exponents."""
    return unit.replace("^2", "²").replace("^3", "³")


def format_expression(text: str) -> str:
    """Return a combination of parameters with dots for its products: `a.izz + 0.16 · b.mass`."""
    return text.replace("*", " · ")


def format_list(items: Iterable[str], most: int = 6) -> str:
    """Return `a, b and c`, or the first few and how many more."""
    items = list(items)
    if len(items) > most:
        return f"{', '.join(items[:most])} and {len(items) - most} more"
    return " and ".join([", ".join(items[:-1]), items[-1]]) if len(items) > 1 else "".join(items)


def count(n: int, noun: str) -> str:
    """Return `1 log`, `3 logs`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _tiny_or_huge(value: float) -> bool:
    return value != 0 and not 1e-4 <= abs(value) < 1e7


def replace_minus_signs(text: str) -> str:
    """Return a text of numbers with true minus signs."""
    return text.replace("-", "−")
