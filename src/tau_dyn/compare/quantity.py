"""A value with its standard error, as it stands in a result, and whether data or only a prior stand behind it."""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

_LEFT = 0.01
"""Relative distance of a standard error from its prior's below which the data added nothing (2 % of the information)."""
_STAYED = 0.2
"""Distance from the nominal value, in standard errors, within which a value that data added nothing to has stayed."""


class MeasuredQuantity(NamedTuple):
    """A value, its standard error (None where no data determined it), and its unit.

    `at_prior`: the standard error is that of the prior the value started from, so no data determined it either.
    """

    value: float
    stderr: float | None
    unit: str
    at_prior: bool = False

    @property
    def determined(self) -> bool:
        """Whether data stand behind the value."""
        return self.stderr is not None and not self.at_prior


def build_measured_quantity(
    value: Any, stderr: Any, unit: Any, *, prior: Any = None, nominal: Any = None
) -> MeasuredQuantity:
    """Return a value that was read; a standard error that is none, such as zero, is taken as not known.

    Args:
        value: The value [unit].
        stderr: Its standard error [unit], or None.
        unit: Its unit.
        prior: Standard error of what was known beforehand [unit], or None.
        nominal: What was known beforehand [unit]; None where that is not told, then `prior` alone counts.

    Raises:
        TypeError: One of them is no number.
        ValueError: A text is no number.
        OverflowError: An integer too large for a float.
    """
    known = None if stderr is None or not isfinite(float(stderr)) or float(stderr) <= 0 else float(stderr)
    held = known is not None and prior is not None and abs(known - float(prior)) <= _LEFT * float(prior)
    if known is not None and held and nominal is not None:
        held = abs(float(value) - float(nominal)) <= _STAYED * known
    return MeasuredQuantity(float(value), known, str(unit), held)
