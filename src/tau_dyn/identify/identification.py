"""Identification of masses and friction from torque logs: the whole main path in one place.

    robot, logs -> Model -> Data -> Regression -> Estimate -> errors on data the fit never saw -> Identification

Doubtful results are reported as warnings: parameters that the motion does not determine, values moved by physical
constraints, and models that the data cannot distinguish.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.effects import FRICTION_MODELS
from tau_dyn.estimate import MAX_RELATIVE_STDERR, Estimate, Preparation, Regression
from tau_dyn.evidence import (
    LogChange,
    build_shared_columns,
    compute_overfit_factor,
    describe_changes,
    describe_poor_fits,
    find_changes,
    find_poor_fits,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.bands import PredictiveBands, build_predictive_bands
from tau_dyn.identify.data import BuiltData, Data, drop_repeated_logs, get_log_list, list_provenance, require_forces
from tau_dyn.identify.estimate_warnings import (
    list_equivalent_models,
    list_estimate_warnings,
    list_friction_sign_warnings,
    list_held_out_warnings,
    list_inertia_scale_warnings,
    list_resting_warnings,
    list_unjudged_joint_warnings,
)
from tau_dyn.identify.estimators import Estimator, Settled, iterate_to_fixed_point
from tau_dyn.identify.fitted_model import Choices, build_model, build_physical_constraints, find_structural_base
from tau_dyn.identify.force_offset import ForceOffset, build_offset_columns, estimate_offset, widen_by_offset
from tau_dyn.identify.internal_force import estimate_internal_force
from tau_dyn.identify.loop_positions import complete_positions
from tau_dyn.identify.motor_electrics import (
    estimate_motor_electrics,
    list_short_voltage_warnings,
    list_voltage_warnings,
)
from tau_dyn.identify.per_log import (
    average_over_logs,
    choose_per_log,
    compare_logs,
    list_comparison_warnings,
    name_apart,
    split_bodies,
)
from tau_dyn.identify.preparation import TooShort, count_information, list_information_warnings
from tau_dyn.identify.result import ForceErrors, Identification, build_force_errors
from tau_dyn.identify.streaming import BlockExecutor
from tau_dyn.legged import complete_base, list_base_warnings
from tau_dyn.log import Log, Recording
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import BodyPrior, Robot
from tau_dyn.scale import count_cores


def identify(
    robot: Robot,
    logs: Log | Recording | Iterable[Log | Recording],
    *,
    holdout: Log | Recording | Iterable[Log | Recording] = (),
    model: str | Path | Model = "asymmetric",
    choices: Choices | None = None,
    preparation: Preparation | None = None,
    exclude: tuple[str, ...] = (),
    per_log: Sequence[str] = (),
    estimator: str = "auto",
    seed: int = 0,
    engine: BlockExecutor | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> Identification:
    """Identify a robot's parameters from torque logs.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `q_J` and `tau_J` of every actuated joint; recordings on disk (`open_log`) may exceed memory.
        holdout: Logs to judge on; without any, the last 30 % of each log, predicted by a fit of the first 70 %.
        model: `rigid`, `symmetric`, `asymmetric`, a model file, or a model.
        choices: Parameters that are fixed, free, bounded or measured beforehand.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        per_log: Names or patterns of parameters that have a value per log, estimated by `wls`.
        estimator: `wls`, `ml`, `iv`, `robust` or `auto`; see `estimators.py`.
        seed: Seed of the random states of the structural study.
        engine: Executor for the blocks of recordings on disk; by default as many threads as there are cores.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the model or a choice is at fault.
        CannotAnswer: The logs determine no parameter.

    Example:
        >>> t, w = np.arange(0.0, 10.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> log = td.Log(t, {"q_axis": q, "tau_axis": 90.0 * a + 20.0 * np.sign(v)})
        >>> found = td.identify(td.load_robot("linear_axis"), log)
        >>> round(found.parameters["carriage_link.mass"].value, 1)
        90.0
        >>> found.parameters.select("*.coulomb_*").names
        ('axis.coulomb_pos', 'axis.coulomb_neg')
    """
    given, judged = get_log_list(logs), get_log_list(holdout)
    if per_log:
        given, estimator = name_apart(given), _require_wls(estimator)
    warnings: list[str] = []  # often the reason if the identification fails
    try:
        how = {"engine": engine or BlockExecutor(count_cores()), "progress": progress}
        data, held_out, gains, doubled = _gather_data(
            choices or Choices(), build_model(robot, model), given, judged, preparation, exclude, per_log, how
        )
        fitted, train, held = data.model, data.logs, held_out.logs
        _refuse_in_blocks(estimator, data)
        warnings += [*data.warnings(), *held_out.warnings(), *fitted.robot.warnings, *doubled]

        progress("columns")
        built = data.build(fitted)
        warnings += [*built.left_out, *list_resting_warnings(built.regression, fitted.robot.driven)]
        refuse_constant_forces(train, built.regression, fitted.robot.driven)
        warnings += _list_singularities(fitted, built.regression)
        changes = _find_changes(fitted, built.regression)
        warnings += describe_changes(changes)

        progress("structure")
        solver = Estimator(estimator, fitted, built.data.pieces, gains, find_structural_base(fitted, seed))
        warnings += list_information_warnings(built.regression, solver.structural_rank)

        progress("estimate")
        settled = _settled_or_scarce(built, solver)
        warnings += settled.warnings

        progress("timing")
        settled, offset = _account_for_timing(settled, solver)
        warnings += settled.warnings

        progress("held-out errors")
        errors = _judge_held_out(held_out, settled, offset) if judged else _judge_last_part(settled.built, solver)
        warnings += errors.warnings
        if held and errors.regression is not None:
            later = _find_changes(fitted, errors.regression)
            warnings += describe_changes(later)
            changes = (*changes, *later)
        _refuse_if_nothing_determined(settled.estimate)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise
    trained, estimate = build_force_errors(settled.built.regression, settled.estimate.theta), settled.estimate
    warnings += describe_poor_fits(find_poor_fits(estimate.regression, estimate.residuals()))
    split = settled.built.regression.parameters
    nominal = fitted.parameters + Parameters([p for p in split if p.name not in fitted.parameters])
    compared = compare_logs(estimate, data.per_log, nominal)
    warnings += list_comparison_warnings(compared)
    warnings += list_unjudged_joint_warnings(trained, errors.errors)
    in_memory = settled.built.regression.everything is None
    overfit = (
        compute_overfit_factor(count_information(settled.built.regression), solver.structural_rank)
        if in_memory
        else 1.0
    )
    warnings += list_held_out_warnings(trained, errors.errors if held else None, overfit)
    warnings += list_voltage_warnings(train, fitted.robot.driven)
    warnings += list_short_voltage_warnings(estimate)
    bodies = BodyPrior.of(fitted.robot)
    warnings += list_estimate_warnings(estimate, bodies.size, bodies.rough)
    warnings += list_inertia_scale_warnings(estimate, nominal)
    return Identification(
        model=replace(_place(fitted, estimate), provenance=list_provenance(train, held, seed)),
        estimate=estimate,
        train=trained,
        holdout=errors.errors,
        holdout_how=errors.how,
        held=errors.regression,
        nominal=nominal,
        friction=model if isinstance(model, str) and model in FRICTION_MODELS else "",
        warnings=tuple(dict.fromkeys(warnings)),
        equivalent=list_equivalent_models(estimate, fitted.robot.driven),
        seed=seed,
        logs=train,
        force_offset=offset,
        per_log=compared,
        bands=errors.bands,
        changes=changes,
        motors=estimate_motor_electrics(estimate),
        internal_force=estimate_internal_force(_place(fitted, estimate), estimate, data.pieces),
    )


def _require_wls(estimator: str) -> str:
    """Return the estimator of values per log; the others look at the log's own samples with shared columns."""
    if estimator not in ("auto", "wls"):
        raise InputError("bad_option", f"--per-log goes with --estimator wls, not with {estimator}")
    return "wls"


def _place(model: Model, estimate: Estimate) -> Model:
    """Return a model at an estimate's values."""
    return model.with_parameters(average_over_logs(estimate, model.parameters))


class _Gathered(NamedTuple):
    """Training and held-out data, each joint's force factor and its deviation, and warnings about repeated logs."""

    data: Data
    held_out: Data
    gains: Mapping[str, tuple[float, float]]
    doubled: Sequence[str]


def _gather_data(
    choices: Choices,
    model: Model,
    given: Sequence[Log | Recording],
    judged: Sequence[Log | Recording],
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    per_log: Sequence[str],
    how: Mapping[str, Any],
) -> _Gathered:
    """Return the data for the requested model, without computing any of it."""
    fitted = choices.apply(model)
    if not fitted.parameters.free.any():
        raise InputError(
            "bad_option",
            "every parameter is fixed, so no value is estimated. To judge a model on a new log, free its parameters, name "
            "the logs that it was fitted to, and the new one with --holdout",
        )
    gains = choices.gains(fitted.robot.driven)
    if gains and fitted.robot.redundant_joints:
        raise InputError(
            "bad_option",
            "--fix JOINT.drive_gain is for robots with as many drives as freedoms; scale the forces in the column map",
        )
    train, held, doubled = drop_repeated_logs(*(complete_positions(fitted.robot, some) for some in (given, judged)))
    require_forces(fitted.robot, [*train, *held])
    doubled = [*doubled, *list_base_warnings(fitted.robot, [*train, *held])]
    train, held = (complete_base(fitted.robot, some) for some in (train, held))
    how = {**how, "factors": {joint: factor for joint, (factor, _) in gains.items()}}
    data = Data.of(
        fitted,
        train,
        preparation=preparation,
        exclude=exclude,
        per_log=choose_per_log(fitted.parameters, per_log),
        **how,
    )
    return _Gathered(data, Data.of(fitted, held, campaigns=tuple(log.name for log in train), **how), gains, doubled)


def _settled_or_scarce(built: BuiltData, solver: Estimator) -> Settled:
    """Return the estimate; if it fails because the logs hold less information than unknowns, raise an error with that reason."""
    try:
        return iterate_to_fixed_point(built, solver)
    except InputError as fault:
        held, rank = count_information(built.regression), solver.structural_rank
        if built.regression.everything is not None or held >= rank:
            raise
        raise TooShort(
            "too_little_data",
            f"the logs hold about {held:.0f} independent values for {rank} parameters and combinations",
            "record half a minute or more, in both directions and over several speeds",
        ) from fault


def _account_for_timing(settled: Settled, solver: Estimator) -> tuple[Settled, ForceOffset | None]:
    """Return the fit with forces shifted to the time they acted, and standard errors that include the shift's uncertainty."""
    built, estimate, model = settled.built, settled.estimate, solver.model
    pieces = built.data.pieces
    columns = build_offset_columns(_place(model, estimate), pieces, built.regression)
    if columns is None:
        return settled, None
    period = max(piece.dt for piece in pieces)
    physics = split_bodies(build_physical_constraints(model), built.regression.parameters)
    offset = estimate_offset(built.regression, columns, period, physics)
    if offset.is_shown:
        late = built.data.shifted(offset.seconds)
        settled = iterate_to_fixed_point(late.build(model), solver)
        offset = replace(offset, corrected=True)
    return settled._replace(estimate=widen_by_offset(settled.estimate, columns, offset)), offset


class _Judged(NamedTuple):
    """Held-out data: their regression if its rows are in memory, errors on them, the method in words, and predictive bands."""

    regression: Regression | None
    errors: ForceErrors | None
    how: str
    warnings: tuple[str, ...] = ()
    bands: PredictiveBands | None = None


def _judge_held_out(held_out: Data, settled: Settled, offset: ForceOffset | None) -> _Judged:
    """Return the errors on held-out logs, prepared like the training logs; empty if all are too short."""
    if not held_out.logs:
        return _Judged(None, None, "no held-out log was left")
    alike = replace(held_out, preparation=settled.built.regression.preparation)
    if offset is not None and offset.corrected:
        alike = alike.shifted(offset.seconds)
    try:
        model = _place(held_out.model, settled.estimate)
        built = alike.build(model)
    except TooShort as fault:
        said = CodedWarning("short_log", f"{fault.missing}; there are no held-out errors")
        return _Judged(None, None, "no held-out log was long enough", (said,))
    how = "held-out logs: " + ", ".join(log.name for log in held_out.logs)
    if settled.built.data.per_log:
        how += f", with the mean over the training logs of {', '.join(settled.built.data.per_log)}"
    theta = model.parameters.values
    errors = build_force_errors(built.regression, theta)
    bands = None if settled.built.data.per_log else build_predictive_bands(settled.estimate, built.regression, theta)
    return _Judged(built.regression, errors, how, built.left_out, bands)


def _judge_last_part(built: BuiltData, solver: Estimator) -> _Judged:
    """Return the errors on the last part of each log, by a fit of its first part."""
    first, last = built.parts()
    try:
        estimate = solver.solve(built, first)
    except CannotAnswer:
        said = (
            "the first 70 % of the logs alone determine no parameters, so there are no held-out errors; give --holdout"
        )
        return _Judged(None, None, "the logs are too short to hold a part out", (said,))
    how = "last 30 % of each log, predicted by a fit of its first 70 %"
    errors = build_force_errors(last, estimate.theta)
    bands = build_predictive_bands(estimate, last, estimate.theta)
    return _Judged(last if built.blocks is None else None, errors, how, estimate.warnings, bands)


def _refuse_in_blocks(estimator: str, data: Data) -> None:
    """Refuse estimators that read all rows repeatedly, if the rows are on disk."""
    if data.streams and estimator not in ("wls", "auto"):
        raise InputError(
            "unsupported",
            f"estimator {estimator} needs all rows in memory, and a recording is too large; use wls, or give an excerpt",
        )


def _find_changes(model: Model, regression: Regression) -> tuple[LogChange, ...]:
    """Return changes within a log; empty for a floating base, where contacts mix the rows of all joints."""
    if model.robot.base_coordinates:
        return ()
    return find_changes(regression, build_shared_columns(regression, model.mechanism))


def _list_singularities(model: Model, regression: Regression) -> list[str]:
    found = []
    for run in regression.runs:
        found += model.mechanism.singularity_warnings(run.signals["q"][:: max(1, len(run.t) // 500)])
    return found


def _refuse_if_nothing_determined(estimate: Estimate) -> None:
    """Refuse an estimate of which no base parameter is known to 30 %, and name the missing excitation.

    Coulomb values whose sum is at zero do not count: they are a constant offset, not friction.
    """
    p = estimate.parameters
    offsets = {name for pair in p.friction_sums if p.is_at_bound(pair[0]) for name in pair}
    counts = np.array([estimate.base.names[kept] not in offsets for kept in estimate.base.kept], dtype=bool)
    if np.any(counts & (estimate.stderr < MAX_RELATIVE_STDERR * np.abs(estimate.beta))):
        return
    suspected = "".join(f" ({text})" for text in list_friction_sign_warnings(estimate)[:1])
    raise CannotAnswer(
        "not_identifiable",
        f"this motion determines no parameter, alone or in combination, to within 30 %{suspected}",
        f"move {', '.join(estimate.regression.outputs)} in both directions over several speeds, accelerate more than the "
        "noise shows, and let the model have friction (--model asymmetric)",
    )


def refuse_constant_forces(logs: Sequence[Log | Recording], regression: Regression, driven: Sequence[str]) -> None:
    """Refuse a force of a driven joint that is constant to the last bit while the joint moves: it was not measured."""
    here = [log for log in logs if isinstance(log, Log)]
    used = [j for k, j in enumerate(regression.outputs) if any(run.usable[:, k].any() for run in regression.runs)]
    moving = [j for j in used if j in driven]
    flat = [j for j in moving if len(here) == len(logs) and all(_flat(log, "tau", j) for log in here)]
    flat = [j for j in flat if not all(_flat(log, "q", j) for log in here)]
    if flat:
        raise CannotAnswer(
            "poor_excitation",
            f"the logged force of {', '.join(flat)} never changes",
            "log the drives' forces and repeat the motion",
        )


def _flat(log: Log, signal: str, joint: str) -> bool:
    return np.ptp(log.joint(signal, [joint])) == 0
