"""Amounts as people say them: `1.80 ± 0.20 N`, `20.9 mm`, `0.52 ms`, and units spelled out for a joint.

`±` is the standard error. Lengths, times, angles and stiffnesses take the prefix that leaves a number of handy size.
"""

from __future__ import annotations

from math import floor, isfinite, log10

from tau_dyn.parameters import Parameter

_PREFIXES = {
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")),
    "m/s": ((1.0, "m/s"), (1e-3, "mm/s"), (1e-6, "µm/s")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "rad": ((1.0, "rad"), (1e-3, "mrad"), (1e-6, "µrad")),
    "rad/s": ((1.0, "rad/s"), (1e-3, "mrad/s")),
    "m/N": ((1.0, "m/N"), (1e-6, "µm/N"), (1e-9, "nm/N")),
    "N/m": ((1e9, "GN/m"), (1e6, "MN/m"), (1e3, "kN/m"), (1.0, "N/m")),
    "N m/rad": ((1e9, "GN m/rad"), (1e6, "MN m/rad"), (1e3, "kN m/rad"), (1.0, "N m/rad")),
    "rad/(N m)": ((1.0, "rad/(N m)"), (1e-6, "µrad/(N m)"), (1e-9, "nrad/(N m)")),
}


def format_amount(parameter: Parameter) -> str:
    """Return a parameter's value with its standard error, where it has one, and its unit."""
    return format_quantity(parameter.value, parameter.unit, parameter.stderr)


def format_quantity(value: float, unit: str, stderr: float | None = None) -> str:
    """Return a value [unit] to the digits that its standard error leaves, or to three."""
    unit = "" if unit == "1" else unit
    scale, unit = _prefixed(max(abs(value), stderr or 0.0), unit)
    value = value / scale
    if stderr is None or not stderr > 0 or not isfinite(stderr):
        return f"{value:.3g} {unit}".strip()
    stderr = stderr / scale
    decimals = 1 - floor(log10(stderr))
    decimals = max(0, decimals - 1 if round(stderr, decimals) >= 10.0 ** (2 - decimals) else decimals)
    if decimals > 7:
        return f"{value:.3g} ± {stderr:.2g} {unit}".strip()
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f} {unit}".strip()


def format_percent(parameter: Parameter) -> str:
    """Return a parameter that is a share, with its standard error, in per cent."""
    return format_quantity(100 * parameter.value, "%", None if parameter.stderr is None else 100 * parameter.stderr)


def spell_unit(unit: str, force: str) -> str:
    """Return a unit with its letters F, V and Q written out for a joint whose force unit is given."""
    position = "m" if force == "N" else "rad"
    if " " in force:
        unit = unit.replace("/F", "/(F)")
    letters = {"F": force, "V": f"{position}/s", "Q": position}
    return "".join(letters.get(c, c) for c in unit)


def describe_one_sided(friction: str, half: Parameter) -> str:
    """Return by how much a friction of one direction exceeds the other's, of which the parameter is half the difference."""
    way = "forward" if half.value >= 0 else "backward"
    more = format_quantity(2 * abs(half.value), half.unit, None if half.stderr is None else 2 * half.stderr)
    return f"{friction} {more} higher when moving {way} than the other way"


def _prefixed(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and the unit that leave a number from one up, where there is one."""
    rows = _PREFIXES.get(unit, ())
    return next((row for row in rows if size >= row[0]), rows[-1] if size > 0 and rows else (1.0, unit))
