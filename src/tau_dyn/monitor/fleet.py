r"""Several units of one type: mean and spread of each parameter, outlying units, and a model as prior of a new unit.

    b_i = beta_i + e_i,   e_i ~ N(0, s_i^2),   beta_i ~ N(mean, spread^2)          for each base parameter

All units have the base parameters of all logs together; undetermined parameters have the same value in every unit. `s_i` is a
unit's standard error. The spread is estimated by Paule & Mandel: the weighted sum of squares about the mean equals the number of
units minus one. Intervals are valid for few units: that of the mean uses Student's t and an estimated scale of at least one
(Hartung & Knapp), that of the spread the chi-square distribution of the same squares (Q profile). A unit is outlying if it is
outside the prediction interval of the others.

The fleet's model holds the means, and as `prior_stderr` the spread of a new unit; `identify --model` uses them as prior
knowledge. The spread there is the upper end of its 80 % interval: a prior that is too narrow biases, one too wide costs little.

Reference: Paule & Mandel 1982; Hartung & Knapp 2001; Roever, Knapp & Friede 2015; Viechtbauer 2007; DerSimonian & Laird 1986.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, stats

from tau_dyn.estimate import Estimate, PhysicalConstraints, Regression, solve_least_squares
from tau_dyn.evidence import DIFFERENCE_LEVEL
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import (
    Choices,
    Data,
    build_model,
    build_physical_constraints,
    complete_positions,
    compute_data_covariance,
    draw_samples,
    drop_repeated_logs,
    find_structural_base,
    log_warnings,
    name_apart,
    refuse_constant_forces,
    require_forces,
)
from tau_dyn.log import Log
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Shown, format_list
from tau_dyn.robot import Robot

MIN_UNITS = 3  # from which a spread can be estimated
_MIN_UNITS_OUTLYING = 4  # from which a unit can be compared with the spread of the others
_PRIOR_TAIL = 0.10  # below the upper end of the spread that a new unit is given
_CENTRE_DRAWS = 400  # whose mean is well inside the consistent set


class FleetParameter(NamedTuple):
    """A base parameter over the units.

    Attributes:
        name: The parameter that represents it.
        expression: The combination that the logs determine.
        unit: SI unit.
        n_units: Units whose logs determine it.
        mean: Mean over units.
        mean_ci95: Its 95 % interval.
        spread: Standard deviation over units.
        spread_ci95: Its 95 % interval.
        prior_stderr: Standard deviation of a new unit's difference from the mean.
        values: The units' own estimates, by unit.
    """

    name: str
    expression: str
    unit: str
    n_units: int
    mean: float
    mean_ci95: tuple[float, float]
    spread: float
    spread_ci95: tuple[float, float]
    prior_stderr: float
    values: Mapping[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        units = {unit: {"value": value, "stderr": stderr} for unit, (value, stderr) in self.values.items()}
        return {
            **self._asdict(),
            "mean_ci95": list(self.mean_ci95),
            "spread_ci95": list(self.spread_ci95),
            "values": units,
        }


class OutlyingUnit(NamedTuple):
    """A unit outside the others' prediction: the parameter, the difference, and the p-value over all parameters and units."""

    unit: str
    parameter: str
    difference: float
    p_value: float


@dataclass(frozen=True, eq=False)
class Fleet(Shown):
    """Units of one type.

    Attributes:
        model: Means as values, with the spread of a new unit as `prior_stderr`.
        units: Names of the units.
        parameters: Mean and spread of each base parameter that three units or more determine.
        outlying: Units that differ from the others.
        warnings: Doubts, as sentences.
        seed: Seed of all random numbers.
    """

    model: Model
    units: tuple[str, ...]
    parameters: tuple[FleetParameter, ...]
    outlying: tuple[OutlyingUnit, ...]
    warnings: tuple[str, ...]
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        return {
            "seed": self.seed,
            **format_warnings(self.warnings),
            "units": list(self.units),
            "parameters": [p.to_dict() for p in self.parameters],
            "outlying": [row._asdict() for row in self.outlying],
        }


class RandomEffects(NamedTuple):
    """Mean and spread of units' values; see `FleetParameter`."""

    mean: float
    mean_stderr: float
    mean_ci95: tuple[float, float]
    spread: float
    spread_ci95: tuple[float, float]
    spread_upper: float


def estimate_random_effects(values: np.ndarray, stderr: np.ndarray) -> RandomEffects:
    """Return mean and spread of units from their estimates (n,) and standard errors (n,)."""
    n = len(values)
    spread2 = _solve_spread(values, stderr, n - 1)
    w = 1 / (stderr**2 + spread2)
    mean = float(w @ values / w.sum())
    scale = max(1.0, float(w @ (values - mean) ** 2) / (n - 1))
    error = float(np.sqrt(scale / w.sum()))
    half = float(stats.t.ppf(0.975, n - 1)) * error
    ends = [_solve_spread(values, stderr, float(stats.chi2.ppf(p, n - 1))) ** 0.5 for p in (0.975, 0.025, _PRIOR_TAIL)]
    return RandomEffects(mean, error, (mean - half, mean + half), spread2**0.5, (ends[0], ends[1]), ends[2])


def _solve_spread(values: np.ndarray, stderr: np.ndarray, wanted: float) -> float:
    """Return the squared spread at which the weighted sum of squares about the mean has a given value; 0 if it is less."""

    def excess(spread2: float) -> float:
        w = 1 / (stderr**2 + spread2)
        return float(w @ (values - w @ values / w.sum()) ** 2) - wanted

    high = float(np.sum((values - values.mean()) ** 2)) / wanted  # without standard errors the squares are just this
    if excess(0.0) <= 0 or high <= 0:
        return 0.0
    return float(optimize.brentq(excess, 0.0, high * (1 + 1e-9), xtol=1e-12 * high))  # type: ignore[arg-type]


def identify_fleet(
    robot: Robot,
    units: Mapping[str, Sequence[Log]],
    *,
    model: str | Model = "asymmetric",
    choices: Choices | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Fleet:
    """Estimate mean and spread of a type's parameters from logs of its units.

    Args:
        robot: The type, with nominal parameters.
        units: Logs of each unit, by its name.
        model: Friction model or model, as `identify` takes it.
        choices: Parameters that are fixed, free or bounded.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of all random numbers.
        progress: Called with a word for each step.

    Raises:
        InputError: A log or a choice is invalid.
        CannotAnswer: There are fewer than three units, or no parameter is determined by three of them.
    """
    if len(units) < MIN_UNITS:
        raise CannotAnswer(
            "too_little_data",
            f"{len(units)} units have no spread to speak of",
            f"record {MIN_UNITS} units or more, best six",
        )
    _, _, doubled = drop_repeated_logs([log for group in units.values() for log in group], ())
    if doubled:
        raise InputError("bad_option", f"{doubled[0].split(';')[0]}; a recording is of one unit, and counts once")
    fitted = (choices or Choices()).apply(build_model(robot, model))
    logs = name_apart(complete_positions(fitted.robot, [log for group in units.values() for log in group]))
    names = [log.name for log in logs]
    owner = dict(zip(names, [unit for unit, group in units.items() for _ in group], strict=True))
    require_forces(fitted.robot, logs)
    progress("columns")
    data = Data.of(fitted, logs, exclude=exclude)
    built = data.build(fitted)
    for unit in units:
        refuse_constant_forces([log for log in logs if owner[log.name] == unit], built.regression, fitted.robot.driven)
    progress("all units together")
    physics = build_physical_constraints(fitted)
    together = solve_least_squares(built.regression, physics=physics, structural=find_structural_base(fitted, seed))
    centre = _find_centre(fitted, together, seed)
    shared = _fix_unseen(built.regression, together, centre)
    progress("units")
    estimates = {unit: _solve_unit(shared, {n for n in names if owner[n] == unit}) for unit in units}
    values = _collect_values(estimates)
    parameters, effects = [], {}
    for k, column in enumerate(together.base.kept):
        name = together.base.names[column]
        told = {unit: row[name] for unit, row in values.items() if name in row}
        if len(told) < MIN_UNITS:
            continue
        found = estimate_random_effects(*np.array(list(told.values())).T)
        effects[name] = found
        parameters.append(
            FleetParameter(
                name, together.base.expression(k), shared.parameters[name].unit, len(told), found.mean, found.mean_ci95,
                found.spread, found.spread_ci95, float(np.hypot(found.spread_upper, found.mean_stderr)), told,
            )
        )  # fmt: skip
    if not parameters:
        raise CannotAnswer(
            "not_identifiable",
            "no parameter is determined by three units or more",
            "record all joints in both directions on each",
        )
    outlying = find_outlying_units(parameters)
    warnings = [*data.warnings(), *log_warnings(fitted.robot, built.data.pieces), *built.left_out]
    return Fleet(
        _build_fleet_model(fitted, shared.parameters, parameters, names), tuple(units), tuple(parameters), outlying,
        tuple(dict.fromkeys([*warnings, *_list_warnings(units, parameters, outlying)])), seed,
    )  # fmt: skip


def _find_centre(model: Model, together: Estimate, seed: int) -> dict[str, float]:
    """Return values of the free parameters well inside the consistent set, so that the units' values stay inside."""
    drawn = draw_samples(model, together, model.parameters, _CENTRE_DRAWS, seed=seed)
    return dict(zip(drawn.names, drawn.values.mean(axis=0).tolist(), strict=True))


def _fix_unseen(regression: Regression, together: Estimate, centre: Mapping[str, float]) -> Regression:
    """Return the regression with one unknown per base parameter; all other parameters are fixed."""
    changes: dict[str, dict[str, Any]] = {name: {"value": centre[name]} for name in together.base.names}
    for column in together.base.dropped:
        changes[together.base.names[column]] |= {"free": False, "prior_stderr": None}
    return regression.with_parameters(regression.parameters.update(changes))


def _solve_unit(regression: Regression, names: set[str]) -> Estimate | None:
    """Return a unit's own estimate; None if its logs determine no parameter."""
    runs = tuple(run for run in regression.runs if run.name in names)
    if not runs:
        return None
    try:
        return solve_least_squares(replace(regression, runs=runs), physics=PhysicalConstraints(()))
    except (CannotAnswer, InputError):
        return None


def _collect_values(estimates: Mapping[str, Estimate | None]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return each unit's values and standard errors of the parameters that its logs determine alone, by parameter."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for unit, estimate in estimates.items():
        if estimate is None:
            continue
        base, stderr = estimate.base, np.sqrt(np.diag(compute_data_covariance(estimate)))
        told = zip(base.kept, estimate.beta_plain, stderr, base.alone[base.kept], strict=True)
        found[unit] = {base.names[c]: (float(x), float(s)) for c, x, s, alone in told if alone}
    return found


def find_outlying_units(parameters: Sequence[FleetParameter]) -> tuple[OutlyingUnit, ...]:
    """Return the units outside of the prediction by the others, the most significant parameter of each (Student's t, Holm)."""
    rows = []
    for p in parameters:
        names, table = list(p.values), np.array(list(p.values.values()))
        if len(names) < _MIN_UNITS_OUTLYING:
            continue
        for k, unit in enumerate(names):
            others = np.delete(table, k, axis=0)
            found = estimate_random_effects(*others.T)
            d = float(table[k, 0] - found.mean)
            t = d / float(np.sqrt(found.spread**2 + found.mean_stderr**2 + table[k, 1] ** 2))
            rows.append(OutlyingUnit(unit, p.name, d, 2 * float(stats.t.sf(abs(t), len(others) - 1))))
    rows.sort(key=lambda row: row.p_value)
    found_units: dict[str, OutlyingUnit] = {}
    for k, row in enumerate(rows):
        corrected = min(1.0, row.p_value * (len(rows) - k))
        if corrected >= DIFFERENCE_LEVEL:
            break
        found_units.setdefault(row.unit, row._replace(p_value=corrected))
    return tuple(found_units.values())


def _build_fleet_model(model: Model, shared: Parameters, told: Sequence[FleetParameter], names: Sequence[str]) -> Model:
    """Return the model of means, with the spread of a new unit."""
    found = {p.name: p for p in told}

    def place(p: Parameter) -> Parameter:
        if p.name not in shared:
            return p
        here = shared[p.name]
        if p.name not in found:
            return replace(here, origin="fleet" if here.free else "fleet, the same in every unit")
        own = found[p.name]
        value = min(max(own.mean, p.lower), p.upper)
        return replace(here, value=value, prior_stderr=own.prior_stderr, stderr=None, origin="mean of the fleet")

    made = model.with_parameters(Parameters([place(p) for p in model.parameters]))
    return replace(made, provenance={**model.provenance, "fleet_of": list(names)})


def _list_warnings(
    units: Mapping[str, Sequence[Log]], parameters: Sequence[FleetParameter], outlying: Sequence[OutlyingUnit]
) -> list[str]:
    said = [
        f"{row.unit} is outlying: its {row.parameter} differs from the others' by {row.difference:.3g}; look at the unit, or "
        "leave its logs out, as it widens the spread"
        for row in outlying
    ]
    partly = [p.name for p in parameters if p.n_units < len(units)]
    if partly:
        said.append(f"not all units tell {format_list(partly, 4)}; record them with the same motion")
    if len(units) < _MIN_UNITS_OUTLYING:
        said.append(f"{len(units)} units do not show whether one of them is outlying; four would")
    return said
