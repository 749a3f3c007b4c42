"""Numbers as text: with their uncertainty, in a readable unit (20.9 mm rather than 0.0209 m), and lists.

`±` is a standard error (`95.14 ± 0.20 kg`); minus signs are true ones. Results and files stay in SI.

Any result as plain data for JSON: dataclasses, arrays, missing numbers, names, paths.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from enum import Enum
from math import floor, isfinite, log10
from pathlib import PurePath
from typing import Any, Protocol

Z95 = 1.959964  # two-sided 95 % point of the normal distribution
_MAX_STDERR = 1e300
"""A standard error beyond this has no decimals that a float can represent."""
ROUNDING = 1e-15
"""Absolute value [SI] below which a number is a rounding error of zero."""
PREFIXED = ("m", "m/s", "rad", "rad/s", "s")
"""Units that get a prefix if the number is small."""


class Estimated(Protocol):
    """A number with its unit and, if estimated, its standard error: a `Parameter`."""

    @property
    def value(self) -> float:
        """The number [unit]."""
        ...

    @property
    def stderr(self) -> float | None:
        """Its standard error [unit], or None."""
        ...

    @property
    def unit(self) -> str:
        """Its unit."""
        ...


def format_number(value: float, digits: int = 4) -> str:
    """Return a number with a given number of significant digits and a true minus sign; rounding errors of zero are 0."""
    value = 0.0 if abs(value) < ROUNDING else value
    text = f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return replace_minus_signs(text if not _tiny_or_huge(value) else f"{value:.{digits - 1}e}")


def format_limit(limit: float, digits: int = 3) -> str:
    """Return a limit as a number, or as `none`."""
    return format_number(limit, digits) if isfinite(limit) else "none"


def format_p_value(p_value: float) -> str:
    """Return a p-value, such as `p = 0.0002`."""
    return f"p = {p_value:.2g}" if p_value >= 1e-6 else "p < 0.000001"


def format_fixed_digits(value: float) -> str:
    """Return a number with three significant digits, including trailing zeros, so that columns align."""
    return (
        format_number(value, 3)
        if _tiny_or_huge(value) or not value
        else replace_minus_signs(f"{value:#.3g}".rstrip("."))
    )


def format_percent(value: float, digits: int = 2) -> str:
    """Return a percentage with two significant digits or more, such as `3.0 %`."""
    if not isfinite(value):
        return "more than 100 %"
    if digits > 2:
        return f"{format_number(value, digits)} %"
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.1f} %" if value >= 0.995 else f"{value:.2g} %"


def choose_decimals(stderr: float) -> int:
    """Return the number of decimals for two significant digits of an uncertainty; negative above 100."""
    if not 0 < stderr < _MAX_STDERR:
        return 3
    decimals = 1 - floor(log10(stderr))
    return decimals - 1 if round(stderr, decimals) >= 10.0 ** (2 - decimals) else decimals


def round_to_stderr(value: float, stderr: float) -> str:
    """Return a value with the digits that its uncertainty supports."""
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
    """Return `a, b and c`, or the first few and the number of the others."""
    items = list(items)
    if len(items) > most:
        return f"{', '.join(items[:most])} and {len(items) - most} more"
    return " and ".join([", ".join(items[:-1]), items[-1]]) if len(items) > 1 else "".join(items)


def count(n: int, noun: str) -> str:
    """Return `1 log`, `3 logs`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def format_thousands(n: int) -> str:
    """Return a whole number with thousands separators."""
    return f"{n:,}".replace(",", " ")


def _tiny_or_huge(value: float) -> bool:
    return value != 0 and not 1e-4 <= abs(value) < 1e7


def replace_minus_signs(text: str) -> str:
    """Return a text of numbers with true minus signs."""
    return text.replace("-", "−")


def choose_unit(unit: str, size: float) -> tuple[float, str]:
    """Return the factor and the unit for a readable quantity of this size [unit]."""
    if unit in PREFIXED and ROUNDING <= abs(size) < 0.1:
        return (1e3, f"m{unit}") if abs(size) >= 1e-4 else (1e6, f"µ{unit}")
    return 1.0, "" if unit == "1" else format_unit(unit)


def format_quantity(value: float, unit: str, digits: int = 3, *, steadily: bool = False) -> str:
    """Return a value with its unit, such as `43 µm`; if `steadily`, with trailing zeros."""
    factor, shown = choose_unit(unit, value)
    return (
        f"{format_fixed_digits(factor * value) if steadily else format_number(factor * value, digits)} {shown}".strip()
    )


def format_estimate(p: Estimated) -> str:
    """Return a parameter's value, standard error and unit, such as `20.90 ± 0.10 mm`."""
    factor, shown = choose_unit(p.unit, p.value)
    sigma = None if p.stderr is None else factor * p.stderr
    return format_with_uncertainty(factor * p.value, sigma, shown)


def format_estimate_interval(p: Estimated) -> str:
    """Return a parameter's 95 % interval in the unit of `format_estimate`; empty if it has no interval."""
    if p.stderr is None or not p.stderr > 0:
        return ""
    factor, _ = choose_unit(p.unit, p.value)
    return format_interval([factor * (p.value + side * Z95 * p.stderr) for side in (-1, 1)], factor * p.stderr)


def format_interval(ends: Iterable[float], stderr: float) -> str:
    """Return an interval's ends with the digits that the standard error supports."""
    return " … ".join(round_to_stderr(end, stderr) for end in ends)


def end_sentence(text: str) -> str:
    """Return a text that ends in a full stop; an empty text stays empty."""
    return text if not text or text.endswith((".", "!", "?")) else f"{text}."


def capitalise(text: str) -> str:
    """Return a text with a capital first letter if it begins with a word, not a name such as a file's or a channel's (`t`)."""
    word = text.split(" ", 1)[0].rstrip(",:;")
    return text[:1].upper() + text[1:] if word.isalpha() and (len(word) > 1 or word == "a") else text


def replace_plus_minus(text: str) -> str:
    """Return a sentence of a result with `±` for `+-`."""
    return text.replace("+-", "±")


def to_plain(value: Any, *, leave_out: Iterable[str] = ()) -> Any:
    """Return a value as dicts, lists, strings, numbers and None.

    A dataclass or a named tuple becomes a dict of its fields, an array nested lists, NaN and infinity None, a complex number
    `re` and `im`, an enum its value, a path and a date their text, a set a sorted list. A value with its own `to_dict` is
    converted by that method.

    Args:
        value: The value to convert.
        leave_out: Fields of the outermost dataclass that are left out.

    Raises:
        TypeError: It contains an object that is not data, such as a function.
    """
    if is_dataclass(value) and not isinstance(value, type):
        hidden = set(leave_out)
        return {f.name: _inner(getattr(value, f.name)) for f in fields(value) if f.name not in hidden}
    return _inner(value)


def _inner(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value if not isinstance(value, Enum) else value.value
    if hasattr(value, "to_dict"):
        return _inner(value.to_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return to_plain(value)
    if hasattr(value, "_asdict"):  # a named tuple
        return _inner(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _inner(item) for key, item in value.items()}
    if hasattr(value, "dtype") and hasattr(value, "tolist"):  # of numpy, which the command line starts without
        return _inner(value.tolist())
    if isinstance(value, complex):
        return {"re": _inner(value.real), "im": _inner(value.imag)}
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, int):
        return value
    if isinstance(value, Enum):
        return _inner(value.value)
    if isinstance(value, PurePath | date):
        return str(value)
    if isinstance(value, set | frozenset):
        return [_inner(item) for item in sorted(value, key=str)]
    if isinstance(value, Iterable):
        return [_inner(item) for item in value]
    raise TypeError(f"{type(value).__name__} is no data")
