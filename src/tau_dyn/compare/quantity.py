"""What a result knows of a value: its standard error, whether data or a prior stand behind it, alone or in a combination.

A combination `w' theta` is determined by a result whose base parameters are `beta = E theta` if and only if `w = E' c`; then it
is `c' beta`. Each base parameter leads with a parameter that no other holds, so `c` is `w` at these. Thus two results are
compared whatever base each has chosen: `a + b` of one is the same as `b + a`, twice `b/2 + a/2`, or the sum of `a` and
`b` where the other determines both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.estimate import read_expression

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


_TOLERANCE = 1e-5
"""Relative difference of two coefficients that are the same; they are written with six digits."""


@dataclass(frozen=True, eq=False)
class BaseParameterCombination:
    """One base parameter.

    Attributes:
        expression: In words, such as `z3_link.mass + r4_link.mass`.
        weights: Coefficient of each parameter, by name.
        quantity: Its value and standard error.
    """

    expression: str
    weights: Mapping[str, float]
    quantity: MeasuredQuantity

    @property
    def alone(self) -> bool:
        """Whether it is a single parameter, which stands among the parameters already."""
        return len(self.weights) == 1


@dataclass(frozen=True, eq=False)
class Combinations:
    """The base parameters of a result; empty where it holds none, as model files do.

    Attributes:
        rows: The r base parameters by the parameter that leads each.
        correlation: Of their estimates (r, r), in the order of `rows`; None where the result has none.
        fixed: Values of the parameters that were given, by name.
    """

    rows: Mapping[str, BaseParameterCombination] = field(default_factory=dict)
    correlation: np.ndarray | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def joint(self) -> tuple[BaseParameterCombination, ...]:
        """Those of more than one parameter."""
        return tuple(row for row in self.rows.values() if not row.alone)

    def parts(self, weights: Mapping[str, float]) -> list[BaseParameterCombination]:
        """Return the base parameters that a combination would be made of."""
        return [self.rows[name] for name in weights if name in self.rows]

    def quantity_of(self, wanted: BaseParameterCombination) -> MeasuredQuantity | None:
        """Return another result's combination as these data determine it; None where they do not.

        The standard error of a sum of several base parameters follows from theirs and their correlation.
        """
        rest, size, value = dict(wanted.weights), {n: abs(x) for n, x in wanted.weights.items()}, 0.0
        factors = [wanted.weights[name] for name in wanted.weights if name in self.rows]
        parts = self.parts(wanted.weights)
        for factor, part in zip(factors, parts, strict=True):
            value += factor * part.quantity.value
            for name, x in part.weights.items():
                rest[name] = rest.get(name, 0.0) - factor * x
                size[name] = size.get(name, 0.0) + abs(factor * x)
        for name, x in rest.items():
            if abs(x) > _TOLERANCE * size[name]:
                if name not in self.fixed:
                    return None
                value += x * self.fixed[name]
        stderr = self._stderr(factors, parts)
        return None if stderr is None else MeasuredQuantity(value, stderr, self._unit(wanted))

    def _unit(self, wanted: BaseParameterCombination) -> str:
        """Return the unit that the leading parameter has here; a combination led by another is scaled to the wanted unit."""
        lead = next(iter(wanted.weights))
        return self.rows[lead].quantity.unit if lead in self.rows else wanted.quantity.unit

    def _stderr(self, factors: list[float], parts: list[BaseParameterCombination]) -> float | None:
        sizes = [part.quantity.stderr for part in parts]
        known = np.array([s for s in sizes if s is not None])
        if not parts or len(known) < len(sizes):
            return None
        scaled = np.array(factors) * known
        if self.correlation is None and len(parts) > 1:
            return None
        order = {id(row): k for k, row in enumerate(self.rows.values())}
        at = [order[id(part)] for part in parts]
        alike = np.eye(1) if self.correlation is None or len(parts) == 1 else self.correlation[np.ix_(at, at)]
        variance = float(scaled @ alike @ scaled)
        return variance**0.5 if np.isfinite(variance) and variance > 0 else None


def read_combinations(content: Mapping[str, Any]) -> Combinations:
    """Read `base_parameters`, `correlation` and `fixed_parameters` of an identification's JSON.

    Raises:
        KeyError: An entry lacks its value or name.
        TypeError: An entry is of the wrong kind.
        ValueError: A text is no number, or the correlation is no table.
    """
    entries = list(pick_dicts(content.get("base_parameters")))
    listed = [*pick_dicts(content.get("parameters")), *pick_dicts(content.get("fixed_parameters")), *entries]
    names = {str(x["name"]) for x in listed if "name" in x}
    rows = dict(_row(x, names) for x in entries)
    matrix = np.asarray(content["correlation"], float) if rows and content.get("correlation") else None
    if matrix is not None and (matrix.shape != 2 * (len(rows),) or not np.isfinite(matrix).all()):
        matrix = None
    fixed = {str(x["name"]): float(x["value"]) for x in pick_dicts(content.get("fixed_parameters"))}
    return Combinations(rows, matrix, fixed)


def _row(entry: Mapping[str, Any], names: set[str]) -> tuple[str, BaseParameterCombination]:
    """Return a base parameter under the name that leads it; what cannot be taken apart is its own name."""
    lead, text = str(entry["name"]), str(entry.get("expression", entry["name"]))
    weights = read_expression(text)
    if not names.issuperset(weights) or weights.get(lead) != 1.0:
        lead, weights = text, {text: 1.0}
    weights = {lead: 1.0} | weights
    held = build_measured_quantity(entry["value"], entry.get("stderr"), entry.get("unit", ""))
    return lead, BaseParameterCombination(text, weights, held)


def pick_dicts(items: Any) -> list[dict[str, Any]]:
    """Return the mappings of a list; none of anything else."""
    return [x for x in items if isinstance(x, dict)] if isinstance(items, list) else []
