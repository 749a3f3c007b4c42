"""Two results beside each other: each quantity, error and finding of both, and what was different around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from scipy.stats import norm

from tau_dyn.compare.circumstances import CircumstanceDifference, InputChange
from tau_dyn.compare.read import ComparedSide
from tau_dyn.message_codes import format_warnings
from tau_dyn.shown import Shown

Determined = Literal["both", "first", "second", "neither"]


@dataclass(frozen=True)
class Change:
    """One quantity in both results.

    Attributes:
        name: Its name; of a combination of parameters, its expression.
        unit: Its unit.
        a: Value in the first [unit].
        b: Value in the second [unit].
        stderr: Standard error of the difference; None where either has none, or no data stand behind either.
        p_value: Chance of such a difference where nothing changed; None without standard error.
        changed: Whether it stands Holm's test; None without standard error.
        determined_by: Which results' data determine it; `neither` where both only hold nominal, given or prior values.
        combination: Whether it is a combination of parameters.
    """

    name: str
    unit: str
    a: float
    b: float
    stderr: float | None
    p_value: float | None
    changed: bool | None
    determined_by: Determined = "both"
    combination: bool = False

    @property
    def difference(self) -> float:
        """Second less first [unit]."""
        return self.b - self.a

    @property
    def ci95(self) -> tuple[float, float] | None:
        """95 % interval of the difference."""
        if self.stderr is None:
            return None
        half = float(norm.isf(0.025)) * self.stderr
        return self.difference - half, self.difference + half

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        interval = None if self.ci95 is None else list(self.ci95)
        row = {"name": self.name, "unit": self.unit, "a": self.a, "b": self.b, "difference": self.difference}
        row |= {"stderr": self.stderr, "ci95": interval, "p_value": self.p_value, "changed": self.changed}
        return {**row, "determined_by": self.determined_by, "combination": self.combination}


@dataclass(frozen=True)
class FindingChange:
    """A cause's status in both results, None where it was not found.

    Attributes:
        cause: Its name; of a check of a log, the topic.
        joints: Joints it acts on.
        a: Status in the first.
        b: Status in the second.
        gain_a: What it is worth on unseen data in the first [%], with its 95 % interval; None where that is not known.
        gain_b: The same in the second.
    """

    cause: str
    joints: tuple[str, ...]
    a: str | None
    b: str | None
    gain_a: tuple[float, float, float] | None = None
    gain_b: tuple[float, float, float] | None = None

    @property
    def what(self) -> str:
        """`appeared`, `vanished`, `changed` or `same`."""
        if self.a == self.b:
            return "same"
        return "appeared" if self.a is None else "vanished" if self.b is None else "changed"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        row = {"cause": self.cause, "joints": list(self.joints), "a": self.a, "b": self.b, "what": self.what}
        return {**row, "gain_a": _gain(self.gain_a), "gain_b": _gain(self.gain_b)}


class ErrorChange(NamedTuple):
    """An error in both results, with its 95 % interval where the result has one."""

    name: str
    unit: str
    a: float
    b: float
    ci95_a: tuple[float, float] | None = None
    ci95_b: tuple[float, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        intervals = {"ci95_a": _list(self.ci95_a), "ci95_b": _list(self.ci95_b)}
        return {"name": self.name, "unit": self.unit, "a": self.a, "b": self.b, **intervals}


@dataclass(frozen=True, eq=False)
class Comparison(Shown):
    """Two results beside each other.

    Attributes:
        a: The first.
        b: The second.
        changes: Quantities that both have, in the first's order, then the combinations of parameters that both determine.
        only_a: Names that only the first has, and combinations that only its data determine.
        only_b: The same of the second.
        errors: Errors that both have.
        findings: Causes found in either.
        warnings: Sentences about what the comparison cannot say.
        inputs: Files that went in, same or not.
        configuration: Options that differ; of run folders only.
        versions: Versions that differ; of run folders only.
        numbers: Plain numbers that differ, without uncertainty.
    """

    a: ComparedSide
    b: ComparedSide
    changes: tuple[Change, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    errors: tuple[ErrorChange, ...]
    findings: tuple[FindingChange, ...]
    warnings: tuple[str, ...]
    inputs: tuple[InputChange, ...] = ()
    configuration: tuple[CircumstanceDifference, ...] = ()
    versions: tuple[CircumstanceDifference, ...] = ()
    numbers: tuple[CircumstanceDifference, ...] = ()

    @property
    def changed(self) -> tuple[Change, ...]:
        """Quantities that differ by more than chance, the clearest first."""
        found = [c for c in self.changes if c.changed]
        return tuple(sorted(found, key=lambda c: -abs(c.difference) / (c.stderr or 1.0)))

    @property
    def compared(self) -> tuple[Change, ...]:
        """Quantities with a standard error of their difference: those that can be judged."""
        return tuple(c for c in self.changes if c.changed is not None)

    @property
    def neither(self) -> tuple[Change, ...]:
        """Quantities that both hold and neither's data determine; that they are alike says nothing of the robot."""
        return tuple(c for c in self.changes if c.determined_by == "neither")

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result."""
        return {
            "kinds": [self.a.kind, self.b.kind],
            "n_compared": len(self.compared),
            "determined_by_neither": [c.name for c in self.neither],
            "changes": [c.to_dict() for c in self.changes],
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "errors": [e.to_dict() for e in self.errors],
            "findings": [f.to_dict() for f in self.findings],
            "input_changes": [i.to_dict() for i in self.inputs],
            "configuration_changes": [d.to_dict() for d in self.configuration],
            "version_changes": [d.to_dict() for d in self.versions],
            "number_changes": [d.to_dict() for d in self.numbers],
            **format_warnings(self.warnings),
        }


def _gain(gain: tuple[float, float, float] | None) -> dict[str, Any] | None:
    return None if gain is None else {"reduction_percent": gain[0], "ci95": [gain[1], gain[2]]}


def _list(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)
