"""Named parameters: names <-> vector, with unit, bounds, fixed or free, uncertainty and origin.

`Parameters` is an ordered, immutable collection of `Parameter` that converts between names and vectors. A fixed parameter is
part of the model, but not of the solver's vector. Names follow the contract: `<link>.mass`, `<joint>.coulomb_pos`, ...
Patterns are shell patterns (`*.armature`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from math import inf, isfinite
from typing import Any, overload

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName, require_kind
from tau_dyn.results import Shown, count, format_estimate

_MAX_SHOWN = 10  # parameters in a `repr`
MAX_VALUE = 1e15
"""Largest value in a file [SI units], as in a log; with larger values sums of squares lose all other numbers."""


def as_numbers(values: object, name: str) -> np.ndarray:
    """Return values as an array of floats, of the shape that they have.

    Raises:
        InputError: One of them is no number.
    """
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as fault:
        raise InputError("invalid_value", f"{name} has to hold numbers ({fault})") from fault


@dataclass(frozen=True)
class Parameter:
    """One number of a model with unit, bounds, uncertainty and origin.

    Attributes:
        name: Contract name, `<owner>.<quantity>`.
        value: Current value [unit].
        unit: SI unit as text.
        lower: Smallest admissible value [unit].
        upper: Largest admissible value [unit].
        free: Whether a solver may change it.
        prior_stderr: Standard deviation of `value` as prior knowledge [unit]; None for no knowledge (free) or
            for a value taken as exact (fixed).
        stderr: Standard error of an estimate [unit], None if it was not estimated.
        origin: Source of the value, in words.
        split: Whether only a combination with other parameters was identified: the value is one of many with the same forces,
            and is not an estimate.
    """

    name: str
    value: float
    unit: str
    lower: float = -inf
    upper: float = inf
    free: bool = True
    prior_stderr: float | None = None
    stderr: float | None = None
    origin: str = "robot file"
    split: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers from which no solver can start."""
        if not isfinite(self.value):
            raise InputError("invalid_value", f"parameter {self.name} must be a finite number, not {self.value}")
        if not self.lower <= self.upper:
            raise InputError(
                "invalid_value", f"parameter {self.name}: lower bound {self.lower} is above upper bound {self.upper}"
            )

    @property
    def at_bound(self) -> bool:
        """Whether the value is at one of its bounds."""
        scale = max(abs(self.value), 1e-12)
        return bool(abs(self.value - self.lower) < 1e-6 * scale or abs(self.value - self.upper) < 1e-6 * scale)


_COULOMB = (".coulomb_pos", ".coulomb_neg")
"""Ends of the names of a joint's Coulomb values in the two directions."""


class Parameters(Shown):
    """An ordered, immutable collection of `Parameter`, addressed by name or by shell pattern."""

    def __init__(self, items: Iterable[Parameter] = ()) -> None:
        """Collect parameters; names must be unique."""
        self._items: dict[str, Parameter] = {}
        for item in items:
            if item.name in self._items:
                raise InputError("duplicate_name", f"parameter {item.name} is defined twice")
            self._items[item.name] = item

    def __iter__(self) -> Iterator[Parameter]:
        """Iterate over parameters in order."""
        return iter(self._items.values())

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self._items)

    def __contains__(self, name: object) -> bool:
        """Return whether a parameter of that name exists."""
        return name in self._items

    @overload
    def __getitem__(self, key: str | int) -> Parameter: ...
    @overload
    def __getitem__(self, key: slice) -> Parameters: ...
    def __getitem__(self, key: str | int | slice) -> Parameter | Parameters:
        """Return the parameter of a name or a place, or those of a slice; `select` takes patterns.

        Raises:
            UnknownName: No parameter has that name; the error lists the existing names.
        """
        if isinstance(key, slice):
            return Parameters(list(self)[key])
        if isinstance(key, int):
            return list(self)[key]
        if key not in self._items:
            raise UnknownName("parameter", key, self._items)
        return self._items[key]

    def __add__(self, other: Parameters) -> Parameters:
        """Concatenate two collections."""
        return Parameters([*self, *other])

    def __repr__(self) -> str:
        """Return one line per parameter with name and value, at most ten."""
        shown = list(self)[: len(self) if len(self) <= _MAX_SHOWN else _MAX_SHOWN - 1]
        width = max((len(p.name) for p in shown), default=0)
        more = [f"  and {len(self) - len(shown)} more"] if len(shown) < len(self) else []
        rows = [f"  {p.name:<{width}}  {format_estimate(p)}" for p in shown]
        return "\n".join([f"Parameters: {count(len(self), 'parameter')}", *rows, *more])

    @property
    def friction_sums(self) -> tuple[tuple[str, str], ...]:
        """Names of the two Coulomb values of a joint; their sum, twice the friction, is at least zero.

        Each alone may be negative: a constant offset of the force sensor increases one and decreases the other.
        """
        firsts = [name.removesuffix(_COULOMB[0]) for name in self._items if name.endswith(_COULOMB[0])]
        pairs = ((joint + _COULOMB[0], joint + _COULOMB[1]) for joint in firsts)
        return tuple(pair for pair in pairs if pair[1] in self._items)

    def is_at_bound(self, name: str) -> bool:
        """Return whether a value is at one of its bounds, or the sum of a joint's Coulomb values at zero."""
        if self[name].at_bound:
            return True
        pairs = [[self[one].value for one in pair] for pair in self.friction_sums if name in pair]
        return any(abs(sum(pair)) <= 1e-6 * max(map(abs, pair)) for pair in pairs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(self._items)

    @property
    def values(self) -> np.ndarray:
        """Values in order (p,)."""
        return np.array([p.value for p in self])

    @property
    def free(self) -> np.ndarray:
        """Mask of free parameters (p,)."""
        return np.array([p.free for p in self], dtype=bool)

    def match(self, pattern: str) -> tuple[str, ...]:
        """Return the names matching a shell pattern; an unmatched pattern is an error."""
        found = tuple(n for n in self._items if fnmatchcase(n, pattern))
        if not found:
            raise UnknownName("parameter", pattern, self._items)
        return found

    def select(self, names: str | Iterable[str]) -> Parameters:
        """Return the parameters of names or shell patterns, each once, in the order given.

        Raises:
            UnknownName: A name or a pattern matches no parameter.
        """
        asked = [names] if isinstance(names, str) else names
        found = [name for n in asked for name in ([n] if n in self._items else self.match(n))]
        return Parameters([self._items[name] for name in dict.fromkeys(found)])

    def with_values(self, values: Mapping[str, float] | np.ndarray) -> Parameters:
        """Return a copy with other values: by name, or a whole vector (p,) in order."""
        if isinstance(values, np.ndarray):
            if values.shape != (len(self),):
                raise InputError(
                    "wrong_shape", f"expected {len(self)} values, one a parameter, not an array of shape {values.shape}"
                )
            values = dict(zip(self.names, values.tolist(), strict=True))
        require_kind(values, Mapping, "set of values", "a dictionary from name to number, or an array")
        return self.update({name: {"value": float(as_numbers(value, name))} for name, value in values.items()})

    def update(self, changes: Mapping[str, Mapping[str, Any]]) -> Parameters:
        """Return a copy in which the named parameters have some attributes replaced."""
        for name in changes:
            self[name]
        return Parameters([replace(p, **changes[p.name]) if p.name in changes else p for p in self])

    def to_list(self) -> list[dict[str, Any]]:
        """Return plain dictionaries for YAML or JSON; infinite bounds are left out."""
        rows = []
        for p in self:
            row = {k: v for k, v in asdict(p).items() if v is not None and not (k == "split" and not v)}
            row = {k: v for k, v in row.items() if not (isinstance(v, float) and not isfinite(v))}
            rows.append(row)
        return rows

    @classmethod
    def from_list(cls, rows: object, where: str = "parameters") -> Parameters:
        """Read the output of `to_list`; other content raises an `InputError` that names the entry."""
        if not isinstance(rows, list):
            raise InputError("file_format", f"{where}: expected a list of parameters")
        known = set(Parameter.__dataclass_fields__)
        items = []
        for k, row in enumerate(rows):
            if not isinstance(row, dict) or not {"name", "value", "unit"} <= set(row) or not set(row) <= known:
                raise InputError(
                    "file_format",
                    f"{where}: entry {k + 1} must have name, value, unit and only {', '.join(sorted(known))}",
                )
            numbers = {key: row[key] for key in ("value", "lower", "upper", "prior_stderr", "stderr") if key in row}
            bad = [key for key, v in numbers.items() if isinstance(v, bool) or not isinstance(v, int | float)]
            if bad:
                raise InputError(
                    "file_format", f"{where}: {row['name']}.{bad[0]} must be a number, not {numbers[bad[0]]!r}"
                )
            if abs(numbers["value"]) > MAX_VALUE:
                raise InputError(
                    "invalid_value",
                    f"{where}: {row['name']}.value is {numbers['value']:g}, larger than anything in SI units",
                )
            odd = [
                key
                for key, v in row.items()
                if key not in numbers and not isinstance(v, bool if key in ("free", "split") else str)
            ]
            if odd:
                raise InputError("file_format", f"{where}: entry {k + 1}: {odd[0]} must not be {row[odd[0]]!r}")
            items.append({**row, **{key: float(v) for key, v in numbers.items()}})
        try:
            return cls(Parameter(**item) for item in items)
        except InputError as fault:
            raise InputError(fault.code, f"{where}: {fault}") from fault
