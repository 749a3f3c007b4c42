"""The result of `identify`, and its JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.estimate import (
    MAX_RELATIVE_STDERR,
    DeterminedCombinations,
    Estimate,
    Regression,
    SufficientStatistics,
    find_determined_combinations,
)
from tau_dyn.evidence import LogChange, list_changes
from tau_dyn.exceptions import InputError
from tau_dyn.identify.bands import PredictiveBands
from tau_dyn.identify.force_offset import ForceOffset
from tau_dyn.identify.internal_force import InternalForce
from tau_dyn.identify.per_log import PerLogParameter
from tau_dyn.identify.posterior import Samples, draw_samples
from tau_dyn.log import Log, Recording
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Z95, PlottedSegment, Shown, plot_outputs
from tau_dyn.robot import BodyPrior, compute_nominal_stderr

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SMALL_SHARE = 0.025
"""Standard error of a parameter, relative to its body's size, that counts as small: a tenth of that of a rough file."""


@dataclass(frozen=True, eq=False)
class ForceErrors:
    """Errors of predicted forces on some logs: the one definition of `identify`, `diagnose` and of every validation.

    Residual = measured - predicted. Both went through the filter that was chosen from the training logs, and masked samples are
    left out (`preparation.py`). Means are not subtracted.

    Attributes:
        joints: Actuated joints.
        rms: Residual rms of each joint over the used samples (na,) [N or N m].
        relative_error_percent: `100 norm(residual) / norm(tau)` over the used samples of all joints.
        per_joint_percent: The same for each joint (na,).
        all_samples: The same three numbers without masks; None inside this object itself.
        unjudged: Joints without any unmasked sample; their zeros carry no information.
        used_share: Share of the samples that the masks leave.
        used_shares: The same for each joint; empty inside `all_samples`.
    """

    joints: tuple[str, ...]
    rms: np.ndarray
    relative_error_percent: float
    per_joint_percent: np.ndarray
    used_share: float
    all_samples: ForceErrors | None
    unjudged: tuple[str, ...] = ()
    used_shares: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        rows = zip(self.joints, self.rms, self.per_joint_percent, strict=True)
        out: dict[str, Any] = {
            "relative_error_percent": self.relative_error_percent,
            "per_joint": {j: {"rms": float(r), "relative_error_percent": float(p)} for j, r, p in rows},
        }
        if self.all_samples is not None:
            out |= {
                "used_share": self.used_share,
                "used_share_per_joint": dict(zip(self.joints, self.used_shares, strict=False)),
                "all_samples": self.all_samples.to_dict(),
            }
        return out


def build_force_errors(regression: Regression, theta: np.ndarray) -> ForceErrors:
    """Return the errors of a full parameter vector (p,) on a regression's data."""
    used, every = regression.totals(), regression.totals(whole=True)
    whole = _errors(regression.outputs, every, theta, 1.0, None)
    found = _errors(regression.outputs, used, theta, regression.used_share, whole)
    return replace(found, used_shares=tuple(map(float, used.count / np.maximum(every.count, 1))))


def _errors(
    joints: tuple[str, ...], totals: SufficientStatistics, theta: np.ndarray, share: float, whole: ForceErrors | None
) -> ForceErrors:
    squares, power = totals.squares(theta), totals.power()
    return ForceErrors(
        joints,
        np.sqrt(squares / np.maximum(totals.count, 1)),
        _percent(squares.sum(), power.sum()),
        np.array([_percent(s, p) for s, p in zip(squares, power, strict=True)]),
        share,
        whole,
        tuple(joint for joint, n in zip(joints, totals.count, strict=True) if not n),
    )


def _percent(squares: float, power: float) -> float:
    return float(100 * np.sqrt(squares / power)) if power > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Identification(Shown):
    """Identified parameters and how far to trust them.

    Attributes:
        model: The model at its identified values; save it, simulate it, feed it forward.
        estimate: The solved regression.
        train: Errors on the training logs.
        holdout: Errors on held-out data; None without such data.
        holdout_how: How the held-out errors were computed, in words.
        held: The held-out regression, for plots.
        nominal: All parameters before the fit.
        friction: Name of the friction model; empty for a model file.
        warnings: Sentences about doubtful results, one each.
        equivalent: Models that the data cannot distinguish.
        seed: Seed of the random states.
        logs: The training logs, for further steps.
        force_offset: Delay of the logged forces; None if it was not estimated.
        per_log: Parameters that have a value per log; `model` holds their mean.
        motors: Each motor's circuit, if its voltage is logged with current or force.
        bands: Bands that should hold 90 % of the held-out samples; None without held-out samples or if rows are on disk.
        changes: Changes within a log, of its force, friction, tool or base.
        internal_force: Preloads of drives beyond the robot's freedoms; None without such drives.
    """

    model: Model
    estimate: Estimate
    train: ForceErrors
    holdout: ForceErrors | None
    holdout_how: str
    held: Regression | None
    nominal: Parameters
    friction: str
    warnings: tuple[str, ...]
    equivalent: tuple[str, ...]
    seed: int
    logs: tuple[Log | Recording, ...] = ()
    force_offset: ForceOffset | None = None
    per_log: tuple[PerLogParameter, ...] = ()
    bands: PredictiveBands | None = None
    changes: tuple[LogChange, ...] = ()
    motors: Parameters = Parameters(())
    internal_force: InternalForce | None = None

    @property
    def parameters(self) -> Parameters:
        """Identified parameters; for a parameter with a value per log, the mean."""
        return self.model.parameters

    def sample(self, n: int, *, seed: int = 0) -> Samples:
        """Draw robots that the logs and the robot file leave possible, each physically consistent; see `posterior.py`.

        Args:
            n: Number of draws.
            seed: Seed of the random numbers.

        Raises:
            InputError: The number is not positive, or parameters have a value per log.
            CannotAnswer: No consistent robot is near the estimate.
        """
        if self.per_log:
            raise InputError(
                "bad_option", f"--samples gives one set of parameters, and {self.per_log[0].name} has a value per log"
            )
        return draw_samples(self.model, self.estimate, self.nominal, n, seed=seed)

    @property
    def poorly_determined(self) -> list[str]:
        """Parameters with a standard error above 30 %; see `list_poorly_determined`."""
        return list_poorly_determined(self.estimate, BodyPrior.of(self.model.robot).size)

    def rows(self) -> list[dict[str, Any]]:
        """Return the parameter table in the contract's form.

        A parameter that cannot be identified alone has its nominal value as `value` and no standard error; `split_value` is its
        value in the model: one of many splits of the identified combinations that give the same forces.
        """
        return [self._row(p) for p in self.parameters if p.free]

    def base_rows(self) -> list[dict[str, Any]]:
        """Return the base parameters with their expressions.

        A fixed drive inertia that a base parameter contains is a term of its expression, and its value is part of the base
        parameter's value: the data determine the sum for any fixed value.
        """
        base, rows = self.estimate.base, []
        before = self.nominal.select(base.names).values
        for k, (column, value, sigma) in enumerate(
            zip(base.kept, self.estimate.beta, self.estimate.stderr, strict=True)
        ):
            p, fixed = self.estimate.parameters[base.names[column]], self.estimate.sum_contained(k)
            alone = bool(base.alone[column]) and not self.estimate.contained[k]
            nominal = None if self._is_friction(p.name) else float(base.combine(before)[k]) + fixed
            total = float(value) + fixed
            row = {"name": p.name, "expression": self.estimate.expression(k), "value": total, "unit": p.unit}
            row |= _uncertainty(total, float(sigma), p if alone else None)
            row |= {"identifiable": True, "nominal": nominal}
            if alone:
                row |= {key: self._row(p)[key] for key in ("nominal_stderr", "at_bound")}
            else:
                row |= {"nominal_stderr": None, "at_bound": False}
            rows.append(row)
        return rows

    @cached_property
    def determined_combinations(self) -> DeterminedCombinations | None:
        """Combinations that the logs determine better than the robot file; None if they determine every base parameter."""
        return find_determined_combinations(self.estimate, BodyPrior.of(self.model.robot).rough)

    def combination_rows(self) -> list[dict[str, Any]]:
        """Return the determined combinations of several parameters in the contract's form; empty if all base parameters are."""
        found = self.determined_combinations
        if found is None:
            return []
        before = found.base.combine(self.nominal.select(found.base.names).values)
        rows = []
        for k, (column, value, sigma) in enumerate(zip(found.base.kept, found.values, found.stderr, strict=True)):
            inside = found.contained[k]
            if found.base.alone[column] and not inside:
                continue
            p = self.estimate.parameters[found.base.names[column]]
            row = {"expression": found.base.expression(k, inside), "value": float(value), "unit": p.unit}
            row |= _uncertainty(float(value), float(sigma), None)
            fixed = sum(factor * self.parameters[name].value for name, factor in inside.items())
            rows.append(row | {"nominal": None if self._is_friction(p.name) else float(before[k]) + fixed})
        return rows

    def plot(self) -> Figure:
        """Return a Matplotlib figure of measured and predicted forces of the training logs, and the residual.

        Raises:
            InputError: Matplotlib is not installed, or the logs are not kept in memory.
        """
        regression = self.estimate.regression
        runs = () if regression.everything is not None else list_plotted_segments(regression, self.estimate.theta)
        return plot_outputs(runs, regression.outputs, regression.units)

    @property
    def estimator(self) -> str:
        """Name of the estimator that was used; see `estimators.py`."""
        return self.estimate.estimator

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result, without the keys that the command adds (version, inputs, status)."""
        fixed = [p for p in self.parameters if not p.free]
        return {
            "seed": self.seed,
            **format_warnings(self.warnings),
            **list_changes(self.changes),
            "model": self.friction or "file",
            "estimator": self.estimator,
            "parameters": self.rows(),
            "fixed_parameters": [{"name": p.name, "value": p.value, "unit": p.unit, "origin": p.origin} for p in fixed],
            "base_parameters": self.base_rows(),
            "determined_combinations": self.combination_rows(),
            **({"per_log": [one.to_dict() for one in self.per_log]} if self.per_log else {}),
            **({"motors": [_build_motor_row(p) for p in self.motors]} if len(self.motors) else {}),
            **({} if self.internal_force is None else {"internal_force": self.internal_force.to_dict()}),
            **({"merged_links": merged} if (merged := self.model.robot.merged_links) else {}),
            "correlation": self.estimate.correlation.tolist(),
            "equivalent_descriptions": list(self.equivalent),
            "train": self.train.to_dict(),
            "holdout": None if self.holdout is None else self.holdout.to_dict(),
            "holdout_how": self.holdout_how,
            "predictive_bands": None if self.bands is None else self.bands.to_dict(),
            "timing": None if self.force_offset is None else self.force_offset.to_dict(),
            "condition_number": self.estimate.cond,
            "rank": self.estimate.base.rank,
            "n_samples": self.estimate.regression.n_samples,
            "preparation": self.estimate.regression.preparation.to_dict(),
        }

    def _is_at_bound(self, p: Parameter) -> bool:
        """Return whether a parameter is at a bound; one of a single log has only its own bounds."""
        return self.parameters.is_at_bound(p.name) if p.name in self.parameters else p.at_bound

    def _row(self, p: Parameter) -> dict[str, Any]:
        before = self.nominal[p.name]
        seen = p.stderr is not None
        value = p.value if seen else before.value
        trusted = not self._is_friction(p.name)
        row: dict[str, Any] = {"name": p.name, "value": value, "unit": p.unit}
        row |= _uncertainty(value, p.stderr, p)
        row |= {
            "identifiable": self.estimate.identifiable(p.name),
            "nominal": before.value if trusted else None,
            "nominal_stderr": compute_nominal_stderr(before) if trusted else None,
            "at_bound": seen and self._is_at_bound(p),
        }
        if not seen:
            row["depends_on"] = list(self._depends_on(p.name))
            row["split_value"] = p.value
        return row

    def _depends_on(self, name: str) -> tuple[str, ...]:
        base = self.estimate.base
        return base.depends_on(base.names.index(name)) if name in base.names else ()

    def _is_friction(self, name: str) -> bool:
        return name.partition("@")[0] in self.model.effect_parameters


def list_plotted_segments(regression: Regression, theta: np.ndarray) -> list[PlottedSegment]:
    """Return measured forces and those of a full parameter vector (p,) over time."""
    return [
        PlottedSegment(run.name, run.t, run.y_all, {"predicted": run.W_all @ theta}, run.usable)
        for run in regression.runs
    ]


def list_poorly_determined(estimate: Estimate, sizes: Mapping[str, float]) -> list[str]:
    """Return the parameters that the data identify alone, with a standard error above 30 %.

    A value near zero whose standard error is small compared with its body's size is not in the list.

    Args:
        estimate: The fit.
        sizes: Sizes of the bodies' parameters, by name; see `BodyPrior`.
    """
    shown = {n: estimate.parameters[n].stderr for n in estimate.base.names}
    return [
        name
        for name, stderr in shown.items()
        if stderr is not None and not estimate.determined(name) and stderr > SMALL_SHARE * sizes.get(name, 0.0)
    ]


def _build_motor_row(p: Parameter) -> dict[str, Any]:
    return {"name": p.name, "value": p.value, "unit": p.unit} | _uncertainty(p.value, p.stderr, p)


def _uncertainty(value: float, stderr: float | None, p: Parameter | None) -> dict[str, Any]:
    """Return standard error and interval, the interval within the parameter's bounds, if any."""
    if stderr is None:
        return {"stderr": None, "ci95": None, "determined": False}
    lower, upper = (p.lower, p.upper) if p is not None else (-inf, inf)
    return {
        "stderr": stderr,
        "ci95": [max(lower, value - Z95 * stderr), min(upper, value + Z95 * stderr)],
        "determined": bool(stderr < MAX_RELATIVE_STDERR * abs(value)),
    }
