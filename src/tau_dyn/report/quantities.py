"""Numbers in the unit a person would use: 20.9 mm rather than 0.0209 m. Results and files stay in SI."""

from __future__ import annotations

from tau_dyn.parameters import Parameter
from tau_dyn.report.formatting import (
    Z95,
    format_fixed_digits,
    format_number,
    format_unit,
    format_with_uncertainty,
    round_to_stderr,
)

PREFIXED = ("m", "m/s", "rad", "rad/s", "s")
"""Units that take a prefix where the number is small."""


def choose_unit(unit: str, size: float) -> tuple[float, str]:
    """Return the factor and the unit in which a quantity of this size [unit] reads best."""
    if unit in PREFIXED and 0 < abs(size) < 0.1:
        return (1e3, f"m{unit}") if abs(size) >= 1e-4 else (1e6, f"µ{unit}")
    return 1.0, "" if unit == "1" else format_unit(unit)


def format_quantity(value: float, unit: str, digits: int = 3, *, steadily: bool = False) -> str:
    """Return a value with its unit, such as `43 µm`; steadily, it keeps the zeros at its end."""
    factor, shown = choose_unit(unit, value)
    return (
        f"{format_fixed_digits(factor * value) if steadily else format_number(factor * value, digits)} {shown}".strip()
    )


def estimate(p: Parameter) -> str:
    """Return a parameter's value, standard error and unit, such as `20.90 ± 0.10 mm`."""
    factor, shown = choose_unit(p.unit, p.value)
    sigma = None if p.stderr is None else factor * p.stderr
    return format_with_uncertainty(factor * p.value, sigma, shown)


def format_interval(p: Parameter) -> str:
    """Return a parameter's 95 % interval in the unit of `estimate`; empty where it has none."""
    if p.stderr is None or not p.stderr > 0:
        return ""
    factor, _ = choose_unit(p.unit, p.value)
    low, high = (factor * (p.value + side * Z95 * p.stderr) for side in (-1, 1))
    return f"{round_to_stderr(low, factor * p.stderr)} … {round_to_stderr(high, factor * p.stderr)}"
