"""Torque logs -> masses and friction that can be trusted: the whole main path in one place.

    robot, logs -> Model -> Regression -> Estimate -> errors on data the fit never saw -> Identification

What is doubtful is said in sentences: what the motion does not determine, where physics held the answer, which
descriptions the data cannot tell apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.effects import FRICTION_MODELS, build_friction_model
from tau_dyn.estimate import MAX_RELATIVE_STDERR, BaseParameters, Estimate, Regression, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.choices import Choices
from tau_dyn.identify.data import Data
from tau_dyn.identify.drive_inertia import free_drive_inertias
from tau_dyn.identify.errors import ForceErrors, build_force_errors
from tau_dyn.identify.estimate_warnings import (
    list_equivalent_models,
    list_estimate_warnings,
    list_friction_sign_warnings,
    list_held_out_warnings,
    list_inertia_scale_warnings,
    list_unjudged_joint_warnings,
)
from tau_dyn.identify.estimators import Estimator
from tau_dyn.identify.fixed_point import iterate_to_fixed_point
from tau_dyn.identify.log_inputs import drop_duplicate_logs, drop_trained_logs, get_log_list, require_forces
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.resting import list_resting_warnings
from tau_dyn.identify.result import Identification
from tau_dyn.identify.short_pieces import TooShort, count_information, list_information_warnings
from tau_dyn.identify.streaming import BlockExecutor
from tau_dyn.identify.structural_identifiability import build_physical_constraints, find_structural_base
from tau_dyn.identify.timing import (
    ForceOffset,
    build_offset_columns,
    estimate_offset,
    shift_forces,
    widen_by_offset,
)
from tau_dyn.log import Log, Recording
from tau_dyn.model import Model
from tau_dyn.robot import Robot
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
        choices: What is fixed, free, bounded or measured beforehand.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        estimator: `wls`, `ml`, `iv`, `robust` or `auto`; see `estimators.py`.
        seed: Seed of the random states of the structural study.
        engine: Who computes the blocks of recordings on disk; by default as many threads as there are cores.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the model or a choice is at fault.
        CannotAnswer: The logs determine nothing.
    """
    ask = _Request(
        robot=robot,
        train=get_log_list(logs),
        holdout=get_log_list(holdout),
        model=model,
        choices=choices or Choices(),
        preparation=preparation,
        exclude=exclude,
        estimator=estimator,
        seed=seed,
        engine=engine or BlockExecutor(count_cores()),
        progress=progress,
    )
    warnings: list[str] = []
    try:
        return _identify(ask, warnings)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


@dataclass(frozen=True, eq=False)
class _Request:
    """What `identify` was asked; see there."""

    robot: Robot
    train: list[Log | Recording]
    holdout: list[Log | Recording]
    model: str | Path | Model
    choices: Choices
    preparation: Preparation | None
    exclude: tuple[str, ...]
    estimator: str
    seed: int
    engine: BlockExecutor
    progress: Callable[[str], None]


class _Held(NamedTuple):
    """Data that the fit never saw: their regression, where its rows are there to look at, the errors on them, and how."""

    regression: Regression | None
    errors: ForceErrors | None
    how: str


def _identify(ask: _Request, warnings: list[str]) -> Identification:
    """Do what `identify` says, leaving in `warnings` what was doubtful even if no answer comes."""
    model = ask.choices.apply(build_model(ask.robot, ask.model))
    if not model.parameters.free.any():
        raise InputError("bad_option", "every parameter is fixed; nothing is left to estimate")
    gains = ask.choices.gains(model.robot.actuated)
    data, held_out = _data(ask, model, {joint: factor for joint, (factor, _) in gains.items()}, warnings)
    ask.progress("columns")
    training = data.regression(model)
    warnings += [*data.left_out, *list_resting_warnings(training)]
    _refuse_constant_forces(data.logs, training)
    warnings += _singularities(model, training)
    ask.progress("structure")
    better = Estimator(ask.estimator, model, data.pieces, gains, warnings)
    sigmas = {joint: sigma for joint, (_, sigma) in gains.items()}
    solve = _Solver(model, find_structural_base(model, ask.seed), sigmas, better)
    warnings += list_information_warnings(training, solve.structural.rank)
    ask.progress("estimate")
    training, estimate = _settled_or_scarce(model, training, solve, data, warnings)
    ask.progress("timing")
    training, estimate, offset = _account_for_timing(model, data, held_out, training, estimate, solve, warnings)
    ask.progress("held-out errors")
    if held_out.logs:
        held = _judge_held_out(held_out, training, model, estimate, warnings)
    else:
        held = _judge_last_part(data, training, solve, bool(ask.holdout), warnings)
    _refuse_if_nothing_determined(estimate)
    train = build_force_errors(training, estimate.theta)
    warnings += list_unjudged_joint_warnings(train, held.errors)
    warnings += list_held_out_warnings(train, held.errors if held_out.logs else None)
    return Identification(
        model=replace(
            model.with_parameters(estimate.parameters), provenance=_provenance(data.logs, held_out.logs, ask.seed)
        ),
        estimate=estimate,
        train=train,
        holdout=held.errors,
        holdout_how=held.how,
        held=held.regression,
        nominal=model.parameters,
        friction=ask.model if isinstance(ask.model, str) and ask.model in FRICTION_MODELS else "",
        warnings=tuple(
            dict.fromkeys(
                [*warnings, *list_estimate_warnings(estimate), *list_inertia_scale_warnings(estimate, model.parameters)]
            )
        ),
        equivalent=list_equivalent_models(estimate, model.robot.actuated),
        seed=ask.seed,
        logs=tuple(data.logs),
        force_offset=offset,
    )


def _account_for_timing(
    model: Model,
    data: Data,
    held_out: Data,
    training: Regression,
    estimate: Estimate,
    solve: _Solver,
    warnings: list[str],
) -> tuple[Regression, Estimate, ForceOffset | None]:
    """Return the fit with forces read when they acted, and intervals that hold for what is not known of it."""
    columns = build_offset_columns(model.with_parameters(estimate.parameters), data.pieces, training)
    if columns is None:
        return training, estimate, None
    period = max(piece.dt for piece in data.pieces)
    offset = estimate_offset(training, columns, period, build_physical_constraints(model))
    if offset.is_shown:
        for some in (data, held_out):
            some.pieces = [shift_forces(piece, model.robot.actuated, offset.seconds) for piece in some.pieces]
        solve = replace(solve, better=replace(solve.better, pieces=data.pieces))
        training, estimate = iterate_to_fixed_point(model, data.regression(model), solve, data.regression, warnings)
        offset = replace(offset, corrected=True)
    return training, widen_by_offset(estimate, columns, offset), offset


def _data(ask: _Request, model: Model, factors: dict[str, float], warnings: list[str]) -> tuple[Data, Data]:
    """Return what is fitted and what is held out, each log once, and say what is doubtful about them."""
    doubled: list[str] = []
    train = drop_duplicate_logs(ask.train, doubled)
    held = drop_duplicate_logs(drop_trained_logs(train, ask.holdout, doubled), doubled)
    require_forces(model.robot, [*train, *held])
    names = tuple(log.name for log in train)
    data = Data(model, train, ask.preparation, ask.exclude, factors, engine=ask.engine, progress=ask.progress)
    held_out = Data(model, held, factors=factors, campaigns=names, engine=ask.engine, progress=ask.progress)
    refuse_in_blocks(ask.estimator, data.streams)
    warnings += [*data.warnings(), *held_out.warnings(), *model.robot.warnings, *doubled]
    return data, held_out


def refuse_in_blocks(estimator: str, streams: bool) -> None:
    """Refuse estimators that look at all rows again and again, where the rows are on disk."""
    if streams and estimator not in ("wls", "auto"):
        raise InputError(
            "unsupported",
            f"estimator {estimator} needs all rows in memory, and a recording is too large; use wls, or give an excerpt",
        )


def build_model(robot: Robot, model: str | Path | Model) -> Model:
    """Return a model of this robot: friction by name, or the effects and values of a model file.

    Drive inertias that nobody gave are free where data can tell them from the bodies' (`drive_inertia.py`).

    Raises:
        InputError: The model file is of a robot with other actuated joints or parameters.
    """
    if isinstance(model, str) and model in FRICTION_MODELS:
        return free_drive_inertias(Model.of(robot, build_friction_model(model, robot.actuated, robot.force_units)))
    if not isinstance(model, Model):
        if isinstance(model, str) and not Path(model).suffix:
            build_friction_model(model, robot.actuated, robot.force_units)  # says which names there are
        model = Model.load(model)
    if model.robot.actuated != robot.actuated:
        theirs = ", ".join(model.robot.actuated)
        raise InputError(
            "mismatch", f"the model is of a robot with joints {theirs}; this one has {', '.join(robot.actuated)}"
        )
    return free_drive_inertias(model.on(robot))


@dataclass(frozen=True, eq=False)
class _Solver:
    """The estimation of one model, whatever the data."""

    model: Model
    structural: BaseParameters
    gains: dict[str, float]
    better: Estimator

    def __call__(self, regression: Regression) -> Estimate:
        first = solve_least_squares(
            regression,
            physics=build_physical_constraints(self.model),
            structural=self.structural,
            gains=self.gains,
        )
        return self.better(first)


def _singularities(model: Model, regression: Regression) -> list[str]:
    found = []
    for run in regression.runs:
        found += model.mechanism.singularity_warnings(run.signals["q"][:: max(1, len(run.t) // 500)])
    return found


def _settled_or_scarce(
    model: Model, training: Regression, solve: _Solver, data: Data, warnings: list[str]
) -> tuple[Regression, Estimate]:
    """Return the estimate; where it fails on less information than it has unknowns, say that this is the reason."""
    try:
        return iterate_to_fixed_point(model, training, solve, data.regression, warnings)
    except InputError as fault:
        held, rank = count_information(training), solve.structural.rank
        if training.everything is not None or held >= rank:
            raise
        raise TooShort(
            "too_little_data",
            f"the logs hold about {held:.0f} independent values for {rank} parameters and combinations",
            "record half a minute or more, in both directions and over several speeds",
        ) from fault


def _judge_held_out(
    held_out: Data, training: Regression, model: Model, estimate: Estimate, warnings: list[str]
) -> _Held:
    """Return the errors on logs of their own, prepared as those that were fitted; none where all are too short for that."""
    held_out.preparation = training.settings["preparation"]
    try:
        regression = held_out.regression(model.with_parameters(estimate.parameters))
    except TooShort as fault:
        warnings.append(CodedWarning("short_log", f"{fault.missing}; there are no held-out errors"))
        return _Held(None, None, "no held-out log was long enough")
    warnings += held_out.left_out
    how = "held-out logs: " + ", ".join(log.name for log in held_out.logs)
    return _Held(regression, build_force_errors(regression, estimate.theta), how)


def _judge_last_part(data: Data, training: Regression, solve: _Solver, asked: bool, warnings: list[str]) -> _Held:
    """Return the errors on the last part of each log, by a fit of its first part; none where other logs were asked for."""
    if asked:
        return _Held(None, None, "no held-out log was left")
    first, last, there = data.parts(training)
    try:
        estimate = solve(first)
    except CannotAnswer:
        warnings.append(
            "the first 70 % of the logs alone determine nothing, so there are no held-out errors; give --holdout"
        )
        return _Held(None, None, "the logs are too short to hold a part out")
    how = "last 30 % of each log, predicted by a fit of its first 70 %"
    return _Held(last if there else None, build_force_errors(last, estimate.theta), how)


def _refuse_if_nothing_determined(estimate: Estimate) -> None:
    """Refuse an estimate of which no base parameter is known to 30 %, and say what is missing."""
    if np.any(estimate.stderr < MAX_RELATIVE_STDERR * np.abs(estimate.beta)):
        return
    suspected = "".join(f" ({text})" for text in list_friction_sign_warnings(estimate)[:1])
    raise CannotAnswer(
        "not_identifiable",
        f"this motion determines no parameter, alone or in combination, to within 30 %{suspected}",
        f"move {', '.join(estimate.regression.outputs)} in both directions over several speeds, accelerate more than the "
        "noise shows, and let the model have friction (--model asymmetric)",
    )


def _refuse_constant_forces(logs: Sequence[Log | Recording], regression: Regression) -> None:
    """Refuse a force that is the same to the last bit while its joint moves: it was not measured."""
    here = [log for log in logs if isinstance(log, Log)]
    moving = [j for k, j in enumerate(regression.outputs) if any(run.usable[:, k].any() for run in regression.runs)]
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


def _provenance(train: Sequence[Log | Recording], held: Sequence[Log | Recording], seed: int) -> dict:
    from tau_dyn.version import __version__

    def rows(logs: Sequence[Log | Recording]) -> list[dict[str, str]]:
        return [{"path": log.name, "sha256": log.sha256} for log in logs]

    return {"tool_version": __version__, "trained_on": rows(train), "held_out": rows(held), "seed": seed}
