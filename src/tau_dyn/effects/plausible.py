"""Numeric ranges in which an effect's amplitudes lie on real machines, in SI units or as shares of a joint's own forces.

A fit may find any amplitude; a machine cannot have any. Each effect states its ranges with their source in its own file,
`diagnose` confirms nothing outside of them, and the documentation's words are made from them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tau_dyn.effects.words import format_quantity as in_words, spell_unit

REFERENCES = {
    "coulomb": "the joint's Coulomb friction",
    "viscous": "the joint's viscous friction",
    "drag": "the joint's friction at full speed over the speed's square",
    "force": "the joint's largest force",
    "inertia": "the joint's inertia",
}
"""What a bound may be a share of, in words; `diagnose` measures them on the fitted model."""

JointScales = Mapping[str, Mapping[str, float]]
"""Joint -> reference -> its value in SI units; a reference that is missing is not known, and bounds nothing."""


@dataclass(frozen=True)
class PlausibleRange:
    """The range of one amplitude.

    Attributes:
        quantity: What the parameter's name says after the joint, without a number, wave or axis behind it.
        low: Lower bound, in the unit or as a share of the reference.
        high: Upper bound.
        unit: Unit that it holds for, such as `m` or `rad`, as parameters have it; empty for any.
        of: What the bounds are shares of, one of `REFERENCES`; empty for SI units.
        setting: Whether it is that of a setting and no parameter's.
    """

    quantity: str
    low: float
    high: float
    unit: str = ""
    of: str = ""
    setting: bool = False

    def covers(self, name: str, unit: str) -> bool:
        """Return whether the range is that of a parameter, by the part of its name after the joint and by its unit."""
        return (name == self.quantity or name.startswith(f"{self.quantity}_")) and self.unit in ("", unit)

    def bounds(self, joint: str, scales: JointScales) -> tuple[float, float]:
        """Return both bounds for a joint in SI units; infinite where the reference is not known."""
        if not self.of:
            return self.low, self.high
        size = scales.get(joint, {}).get(self.of)
        if size is None:
            return (-np.inf, np.inf)
        return (self.low * size if self.low else 0.0, self.high * size if self.high else 0.0)

    def describe(self) -> str:
        """Return the range in words."""
        name = self.quantity.replace("_", " ")
        if self.of:
            return f"{name} {_share(self.low)} to {_share(self.high)} of {REFERENCES[self.of]}"
        if not self.unit or self.unit == "1":
            return f"{name} {self.low:g} to {self.high:g}"
        low = "0" if self.low == 0 else in_words(self.low, self.unit)
        return f"{name} {low} to {in_words(self.high, self.unit)}"


def describe_ranges(ranges: Iterable[PlausibleRange]) -> str:
    """Return an effect's ranges in words, for the documentation."""
    return "; ".join(one.describe() for one in ranges)


def build_slide_and_hinge_ranges(
    quantity: str, unit: str, low: tuple[float, float], high: tuple[float, float]
) -> list[PlausibleRange]:
    """Return two ranges of one quantity, for a slide and for a hinge; `unit` holds Q and F for position and force."""
    kinds = zip(("N", "N m"), low, high, strict=True)
    return [PlausibleRange(quantity, one, other, spell_unit(unit, force)) for force, one, other in kinds]


def _share(x: float) -> str:
    return "0" if x == 0 else f"{100 * x:g} %"
