"""Changes between two results: each quantity's difference compared with the uncertainty of both.

    z = (b - a) / sqrt(stderr_a^2 + stderr_b^2)

is standard normal if the quantity did not change and the data of both are independent. Quantities have changed if their p-values
are significant in Holm's test at 5 %, so that two results of one unchanged robot report a change once in twenty comparisons
(Holm 1979; it needs no independence between quantities). Resonances are numbered by frequency in each result and are matched to
the nearest. Combinations of parameters are matched by their coefficients (`read.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import hypot
from typing import Any, Literal, NamedTuple

from scipy.stats import norm

from tau_dyn.compare.read import ComparedSide, MeasuredQuantity
from tau_dyn.compare.run import CircumstanceDifference, InputChange, list_differences, list_input_changes
from tau_dyn.exceptions import InputError
from tau_dyn.message_codes import format_warnings
from tau_dyn.results import Shown, to_plain

Determined = Literal["both", "first", "second", "neither"]


@dataclass(frozen=True)
class Change:
    """One quantity in both results.

    Attributes:
        name: Its name; for a combination of parameters, its expression.
        unit: Its unit.
        a: Value in the first [unit].
        b: Value in the second [unit].
        stderr: Standard error of the difference; None if one of them has no standard error, or no data determine either.
        p_value: Probability of such a difference without a change; None without standard error.
        changed: Whether it is significant in Holm's test; None without standard error.
        determined_by: Which results' data determine it; `neither` if both only hold nominal, given or prior values.
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
        """Second minus first [unit]."""
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
        return to_plain(self) | to_plain({"difference": self.difference, "ci95": self.ci95})


@dataclass(frozen=True)
class FindingChange:
    """A cause's status in both results, None if it was not found.

    Attributes:
        cause: Its name; for a check of a log, the topic.
        joints: Joints it acts on.
        a: Status in the first.
        b: Status in the second.
        gain_a: Its gain on held-out data in the first [%], with its 95 % interval; None if unknown.
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
        return to_plain(self) | {"what": self.what, "gain_a": _gain(self.gain_a), "gain_b": _gain(self.gain_b)}


class ErrorChange(NamedTuple):
    """An error in both results, with its 95 % interval if the result has one."""

    name: str
    unit: str
    a: float
    b: float
    ci95_a: tuple[float, float] | None = None
    ci95_b: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Comparison(Shown):
    """Comparison of two results.

    Attributes:
        a: The first.
        b: The second.
        changes: Quantities that both have, in the first's order, then the combinations of parameters that both determine.
        only_a: Names that only the first has, and combinations that only its data determine.
        only_b: The same of the second.
        errors: Errors that both have.
        findings: Causes found in either.
        warnings: Sentences about the limits of the comparison.
        inputs: Input files, same or not.
        configuration: Options that differ; for run folders only.
        versions: Versions that differ; for run folders only.
        numbers: Plain numbers that differ, without uncertainty.
        lacking: Sides that hold no combinations of parameters, so that a change in one is not detected.
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
    lacking: tuple[ComparedSide, ...] = ()

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
        """Quantities that both hold and neither's data determine; their agreement carries no information about the robot."""
        return tuple(c for c in self.changes if c.determined_by == "neither")

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result."""
        told = {
            "kinds": (self.a.kind, self.b.kind),
            "n_compared": len(self.compared),
            "determined_by_neither": [c.name for c in self.neither],
            "input_changes": self.inputs,
            "configuration_changes": self.configuration,
            "version_changes": self.versions,
            "number_changes": self.numbers,
        }
        alike = ("changes", "only_a", "only_b", "errors", "findings")
        return to_plain(told | {key: getattr(self, key) for key in alike}) | format_warnings(self.warnings)


def _gain(gain: tuple[float, float, float] | None) -> dict[str, Any] | None:
    return None if gain is None else {"reduction_percent": gain[0], "ci95": [gain[1], gain[2]]}


SIGNIFICANCE_LEVEL = 0.05
"""Probability that any change is reported without a change (family-wise level)."""
_MAX_RELATIVE_FREQUENCY_DIFFERENCE = 0.2
"""Relative distance within which two resonances are taken for the same one."""


def compare(a: ComparedSide, b: ComparedSide) -> Comparison:
    """Compare two models, results or run folders.

    Raises:
        InputError: They have no quantity in common; two run folders always have their circumstances.
    """
    other = _matched(a.quantities, b.quantities)
    shared = [n for n in a.quantities if n in other]
    causes = dict.fromkeys([*a.findings, *b.findings])
    runs = a.run is not None and b.run is not None
    single = [_change(n, a.quantities[n], other[n]) for n in shared]
    joint, joint_a, joint_b = _joint(a, b, [c.name for c in single if c.stderr is not None])
    changes = [*single, *joint]
    lacking = _list_lacking(a, b, changes, [*joint_a, *joint_b])
    if not changes and not causes and not set(a.errors) & set(b.errors) and not runs:
        raise InputError(
            "mismatch", f"{a.path} ({a.kind}) and {b.path} ({b.kind}) have no quantity, error or finding in common"
        )
    return Comparison(
        a=a,
        b=b,
        changes=tuple(_holm(changes)),
        only_a=(*(n for n in a.quantities if n not in other), *joint_a),
        only_b=(*(n for n in other if n not in a.quantities), *joint_b),
        errors=tuple(_error(n, a, b) for n in a.errors if n in b.errors),
        findings=tuple(
            FindingChange(*key, a.findings.get(key), b.findings.get(key), a.gains.get(key), b.gains.get(key))
            for key in causes
        ),
        warnings=(*_doubts(a, b), *_unmatched(a, b, changes, [*joint_a, *joint_b], lacking)),
        lacking=lacking,
        inputs=list_input_changes(a.inputs, b.inputs),
        numbers=tuple(d for d in list_differences(a.numbers, b.numbers) if d.a is not None and d.b is not None),
        **_of_runs(a, b),
    )


def _of_runs(a: ComparedSide, b: ComparedSide) -> dict[str, tuple[CircumstanceDifference, ...]]:
    if a.run is None or b.run is None:
        return {}
    versions = list_differences(a.run.versions, b.run.versions)
    return {"configuration": list_differences(a.run.configuration, b.run.configuration), "versions": versions}


def _error(name: str, a: ComparedSide, b: ComparedSide) -> ErrorChange:
    (x, unit), (y, _) = a.errors[name], b.errors[name]
    return ErrorChange(name, unit, x, y, a.intervals.get(name), b.intervals.get(name))


def _joint(a: ComparedSide, b: ComparedSide, known: list[str]) -> tuple[list[Change], list[str], list[str]]:
    """Compare the combinations of parameters of both.

    Args:
        a: The first.
        b: The second.
        known: Names of the single parameters that are compared.

    Returns:
        Those that both determine, in the first's order, and the expressions that only the first and only the second do.
    """
    changes, only_a, only_b = [], [], []
    for row in a.combinations.joint:
        theirs = b.combinations.quantity_of(row)
        if theirs is None or row.quantity.stderr is None:
            only_a.append(row.expression)
        else:
            changes.append(_change(row.expression, row.quantity, theirs, combination=True))
    told = {*known, *(c.name for c in changes)}
    for row in b.combinations.joint:
        mine = a.combinations.quantity_of(row)
        if mine is None or row.quantity.stderr is None:
            only_b.append(row.expression)
        elif not told.issuperset(part.expression for part in a.combinations.parts(row.weights)):
            changes.append(_change(row.expression, mine, row.quantity, combination=True))
    return changes, only_a, only_b


def _list_lacking(
    a: ComparedSide, b: ComparedSide, changes: list[Change], alone: list[str]
) -> tuple[ComparedSide, ...]:
    """Return the sides without combinations of parameters, if a change may show only in a combination."""
    given = {*a.combinations.fixed, *b.combinations.fixed}  # no member of any combination
    open_ = alone or any(c.determined_by == "neither" and c.name not in given for c in changes)
    if not open_ or not {a.kind, b.kind} <= {"model", "identify"}:
        return ()
    return tuple(side for side in (a, b) if not side.combinations.rows)


def _unmatched(
    a: ComparedSide, b: ComparedSide, changes: list[Change], alone: list[str], lacking: tuple[ComparedSide, ...]
) -> Iterator[str]:
    """Yield the combinations of parameters that were not compared, and the reason."""
    if alone and a.combinations.rows and b.combinations.rows:
        yield (
            f"{a.place} and {b.place} determine different combinations of parameters; not compared, as only one of them "
            f"determines {'it' if len(alone) == 1 else 'each'}: {'; '.join(alone)}"
        )
    elif lacking and any(c.stderr is not None for c in changes):
        holds = f"{lacking[0].place} holds" if len(lacking) == 1 else f"{a.place} and {b.place} hold"
        yield (
            f"{holds} no combinations of parameters, in which a change may show although no single value shows it; "
            "compare the --json results of identify"
        )


def _change(name: str, a: MeasuredQuantity, b: MeasuredQuantity, *, combination: bool = False) -> Change:
    if a.unit != b.unit:
        raise InputError(
            "mismatch", f"{name} is in {a.unit or 'no unit'} in one and in {b.unit or 'no unit'} in the other"
        )
    by: Determined = ("both" if b.determined else "first") if a.determined else "second" if b.determined else "neither"
    if a.stderr is None or b.stderr is None or by == "neither":
        return Change(name, a.unit, a.value, b.value, None, None, None, by, combination)
    stderr = hypot(a.stderr, b.stderr)
    p_value = float(2 * norm.sf(abs(b.value - a.value) / stderr))
    return Change(name, a.unit, a.value, b.value, stderr, p_value, False, by, combination)


def _holm(changes: list[Change]) -> list[Change]:
    """Mark the changes that are significant in Holm's step-down test."""
    tested = sorted((c.p_value, k) for k, c in enumerate(changes) if c.p_value is not None)
    marked = list(changes)
    for rank, (p, k) in enumerate(tested):
        if p * (len(tested) - rank) > SIGNIFICANCE_LEVEL:
            break
        marked[k] = replace(changes[k], changed=True)
    return marked


def _matched(a: Mapping[str, MeasuredQuantity], b: Mapping[str, MeasuredQuantity]) -> dict[str, MeasuredQuantity]:
    """Return the second's quantities, with its resonances numbered as the nearest of the first."""
    mine, theirs = _frequencies(a), _frequencies(b)
    pairs = sorted(
        (abs(f - g) / f, i, j)
        for i, f in mine.items()
        for j, g in theirs.items()
        if abs(f - g) < _MAX_RELATIVE_FREQUENCY_DIFFERENCE * f
    )
    new: dict[int, int] = {}
    for _, i, j in pairs:
        if j not in new and i not in new.values():
            new[j] = i
    for number, j in enumerate((j for j in theirs if j not in new), max([*mine, 0]) + 1):
        new[j] = number
    found = {}
    for name, quantity in b.items():
        words = name.split(" ")
        if words[0] == "mode" and len(words) == 3 and words[1].isdigit():
            name = f"mode {new[int(words[1])]} {words[2]}"
        found[name] = quantity
    return found


def _frequencies(quantities: Mapping[str, MeasuredQuantity]) -> dict[int, float]:
    names = {n: n.split(" ") for n in quantities if n.startswith("mode ") and n.endswith(" frequency")}
    return {int(words[1]): quantities[n].value for n, words in names.items()}


def _doubts(a: ComparedSide, b: ComparedSide) -> Iterable[str]:
    for side in (a, b):
        if side.missing:
            yield f"{side.place}: its data could not answer ({side.missing})"
    if a.path.resolve() == b.path.resolve():
        yield f"{a.place} and {b.place} are the same"
    elif a.sha256 == b.sha256:
        yield f"{a.path} and {b.path} hold the same bytes"
    elif a.logs & b.logs:
        yield "both rest on the same recordings; the intervals take them as independent and are too wide"
    if a.kind != b.kind:
        yield f"{a.path} comes from {a.kind}, {b.path} from {b.kind}"
