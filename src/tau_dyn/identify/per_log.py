r"""Parameters with a value per log: one joint estimate, and a test of whether the logs differ.

    y_k = W_k theta + w_k theta_k,     k = 1 .. K logs

A named parameter's column `w` becomes one column for each log, zero in all others; everything else is shared. A log is one
campaign: all its pieces have one value. The test is Wald's on contrasts `L beta = 0` between the logs' values, so that sums that
only differ by the named parameter are compared even if no log determines it alone. As intervals take the larger of two standard
errors, the test takes the larger of two p-values: of the autoregressive covariance (chi-square), and of the scatter of 2 s
blocks (Hotelling's T^2 with as many degrees of freedom as blocks). Reference: Wald 1943; Hotelling 1931; Seber & Lee 2003, 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy import stats

from tau_dyn.estimate import Estimate, InertialBody, PhysicalConstraints, Regression, assign_blocks
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, Recording
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Z95

SIGNIFICANCE_LEVEL = 0.01
"""Significance level over all named parameters together (Bonferroni) for a difference between logs."""
_TOLERANCE = 1e-6
"""Relative part of a contrast that the data may leave unseen: base combinations are known to about 1e-9."""

AnyLog = TypeVar("AnyLog", bound=Log | Recording)


class LogValue(NamedTuple):
    """A parameter's value in one log; without standard error if that log does not determine it alone."""

    log: str
    value: float
    stderr: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        half = None if self.stderr is None else Z95 * self.stderr
        ends = None if half is None else [self.value - half, self.value + half]
        return {"log": self.log, "value": self.value, "stderr": self.stderr, "ci95": ends}


@dataclass(frozen=True)
class PerLogParameter:
    """A parameter that has a value per log.

    Attributes:
        name: Contract name.
        unit: Its unit.
        values: One value for each log.
        p_value: Probability of such differences between equal logs, over all named parameters together; None if no two
            logs can be compared.
    """

    name: str
    unit: str
    values: tuple[LogValue, ...]
    p_value: float | None

    @property
    def differ(self) -> bool:
        """Whether the logs differ."""
        return self.p_value is not None and self.p_value < SIGNIFICANCE_LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        values = [value.to_dict() for value in self.values]
        return {
            "name": self.name, "unit": self.unit, "values": values, "p_value": self.p_value, "differ": self.differ,
        }  # fmt: skip


def choose_per_log(parameters: Parameters, patterns: Iterable[str]) -> tuple[str, ...]:
    """Return the free parameters that match patterns.

    Raises:
        UnknownName: A pattern that no parameter has.
        InputError: A pattern names fixed parameters only, or one that was measured beforehand.
    """
    found: list[str] = []
    for pattern in patterns:
        names = parameters.match(pattern)
        free = [n for n in names if parameters[n].free]
        if not free:
            raise InputError("bad_option", f"--per-log {pattern}: {names[0]} is fixed; free it with --free {names[0]}")
        known = [n for n in free if parameters[n].prior_stderr is not None]
        if known:
            raise InputError("bad_option", f"--per-log {pattern}: {known[0]} was measured beforehand, for all logs")
        found += free
    return tuple(dict.fromkeys(found))


def name_apart(logs: Sequence[AnyLog]) -> list[AnyLog]:
    """Return the logs with distinct names: files of one name in two folders are two logs."""
    seen: dict[str, int] = {}
    named = []
    for log in logs:
        seen[log.name] = number = seen.get(log.name, 0) + 1
        named.append(log if number == 1 else replace(log, name=f"{log.name} ({number})"))
    return named


def split_by_log(regression: Regression, names: Sequence[str]) -> Regression:
    """Return the regression in which each named parameter has a column per log, in its place: `name@log`.

    Raises:
        InputError: There is only one log.
    """
    logs = tuple(dict.fromkeys(run.name for run in regression.runs))
    if len(logs) < 2:
        raise InputError(
            "missing_input", f"--per-log compares logs, and there is only {', '.join(logs)}; give two or more"
        )
    rows: list[tuple[int, str | None, Parameter]] = []
    for k, p in enumerate(regression.parameters):
        if p.name in names:
            rows += [(k, log, replace(p, name=f"{p.name}@{log}")) for log in logs]
        else:
            rows.append((k, None, p))
    maps = []
    for run in regression.runs:
        chosen = np.zeros((len(regression.parameters), len(rows)))
        for column, (k, log, _) in enumerate(rows):
            chosen[k, column] = log is None or log == run.name
        maps.append(chosen)
    return regression.combine_columns(Parameters([p for _, _, p in rows]), maps)


def split_bodies(physics: PhysicalConstraints, parameters: Parameters) -> PhysicalConstraints:
    """Return the constraints with one body for each log if a regression has a body's parameters per log."""
    bodies: list[InertialBody] = []
    for body in physics.bodies:
        values = {name: _list_logs(parameters, name) for name in body.parameters if name not in parameters}
        logs: tuple[str, ...] = next(iter(values.values()), ())
        for log in logs:
            names = tuple(f"{name}@{log}" if name in values else name for name in body.parameters)
            bodies.append(InertialBody(f"{body.name}@{log}", names, body.map))
        if not logs:
            bodies.append(body)
    return replace(physics, bodies=tuple(bodies))


def average_over_logs(estimate: Estimate, parameters: Parameters) -> Parameters:
    """Return a model's parameters at an estimate's values; for a value per log, the mean of the determined ones."""
    found = []
    for p in parameters:
        if p.name in estimate.parameters:
            found.append(estimate.parameters[p.name])
            continue
        rows = estimate.parameters.select(f"{p.name}@{log}" for log in _list_logs(estimate.parameters, p.name))
        told = [row for row in rows if row.stderr is not None]
        weights = {row.name: 1 / len(told) for row in told}
        value = float(np.mean([row.value for row in told or rows]))
        stderr = estimate.stderr_of(_weigh(estimate, weights)) if told else None
        found.append(replace(p, value=value, stderr=stderr, origin="mean over the logs"))
    return Parameters(found)


def compare_logs(estimate: Estimate, names: Sequence[str], nominal: Parameters) -> tuple[PerLogParameter, ...]:
    """Return the values per log of the named parameters and whether they differ.

    Args:
        estimate: Estimate of a regression that `split_by_log` made.
        names: The named parameters.
        nominal: Values before the fit; they are reported for logs that do not determine their own.
    """
    found = []
    for name in names:
        rows = {log: estimate.parameters[f"{name}@{log}"] for log in _list_logs(estimate.parameters, name)}
        values = tuple(
            LogValue(log, nominal[name].value if p.stderr is None else p.value, p.stderr) for log, p in rows.items()
        )
        p_value = compute_contrast_p_value(estimate, _list_contrasts(estimate, [p.name for p in rows.values()]))
        corrected = None if p_value is None else min(1.0, len(names) * p_value)
        found.append(PerLogParameter(name, nominal[name].unit, values, corrected))
    return tuple(found)


def list_comparison_warnings(compared: Sequence[PerLogParameter]) -> list[str]:
    """Return a sentence for each parameter of which no two logs can be compared."""
    return [
        f"no two logs tell {one.name} so that they can be compared; move the joints on which it acts in each of them"
        for one in compared
        if one.p_value is None
    ]


def compute_contrast_p_value(estimate: Estimate, contrasts: np.ndarray) -> float | None:
    """Return the p-value of `contrasts @ beta = 0` (Wald), contrasts (q, r) of the base parameters; None without any."""
    q = len(contrasts)
    if not q:
        return None
    d = contrasts @ estimate.beta_plain
    coloured, scattered = (contrasts @ S @ contrasts.T for S in (estimate.cov, estimate.scatter))
    p = float(stats.chi2.sf(_measure(d, coloured), q))
    blocks = _count_blocks(estimate.regression)
    if blocks > q + 1:
        share = (blocks - q) / (q * (blocks - 1))
        p = max(p, float(stats.f.sf(_measure(d, scattered) * share, q, blocks - q)))
    return p


def _measure(d: np.ndarray, S: np.ndarray) -> float:
    """Return `d' S^+ d`, S scaled to unit diagonal; directions in the null space of S count zero (pseudo-inverse)."""
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    return float((d * scale) @ np.linalg.pinv(S * np.outer(scale, scale), hermitian=True) @ (d * scale))


def _count_blocks(regression: Regression) -> int:
    runs = [run for run in regression.runs if run.usable.any()]
    return sum(len(np.unique(assign_blocks(run.t[run.usable.any(axis=1)] - run.t[0]))) for run in runs)


def _list_logs(parameters: Parameters, name: str) -> tuple[str, ...]:
    return tuple(n.removeprefix(f"{name}@") for n in parameters.names if n.startswith(f"{name}@"))


def _weigh(estimate: Estimate, weights: Mapping[str, float]) -> np.ndarray:
    """Return weights of the base parameters (r,) from those of columns that are base parameters by themselves."""
    return np.array([weights.get(estimate.base.names[k], 0.0) for k in estimate.base.kept])


def _list_contrasts(estimate: Estimate, names: Sequence[str]) -> np.ndarray:
    """Return the differences of columns' parameters that the data determine (q, r), all to the reference that gives most."""
    base = estimate.base
    places = {name: base.names.index(name) for name in names if name in base.names}
    best = np.zeros((0, base.rank))
    for first in places:
        rows = []
        for other in places:
            w = np.zeros(len(base.names))
            w[places[other]] += 1.0
            w[places[first]] -= 1.0
            kept, dropped = w[base.kept], w[base.dropped]
            size = np.abs(dropped) + np.abs(base.K.T) @ np.abs(kept)
            if other != first and kept.any() and not np.any(np.abs(dropped - base.K.T @ kept) > _TOLERANCE * size):
                rows.append(kept)
        if len(rows) > len(best):
            best = np.array(rows)
    return best
