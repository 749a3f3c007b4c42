"""Torque logs -> masses and friction that can be trusted: the whole main path in one place.

    robot, logs -> Model -> Regression -> Estimate -> errors on data the fit never saw -> Identification

What is doubtful is said in sentences: what the motion does not determine, where physics held the answer, which
descriptions the data cannot tell apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tau_dyn.effects import FRICTION_MODELS, friction_model
from tau_dyn.estimate import DETERMINED, BaseParameters, Estimate, Regression, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.choices import Choices
from tau_dyn.identify.data import Data
from tau_dyn.identify.doubts import doubts, equivalences, unlike_the_file
from tau_dyn.identify.errors import ForceErrors, force_errors
from tau_dyn.identify.estimators import Estimator
from tau_dyn.identify.logs import each_once, listed, without_trained
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.result import Identification
from tau_dyn.identify.settle import settled
from tau_dyn.identify.streaming import Engine
from tau_dyn.identify.structure import physics_of, structural_base
from tau_dyn.log import Log, Recording
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.scale.run_many import cores


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
    engine: Engine | None = None,
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
    warnings: list[str] = []
    try:
        return _identify(
            robot,
            listed(logs),
            listed(holdout),
            model,
            choices or Choices(),
            preparation,
            exclude,
            estimator,
            seed,
            engine or Engine(cores()),
            progress,
            warnings,
        )
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


def _identify(
    robot: Robot,
    train_logs: list[Log | Recording],
    asked_logs: list[Log | Recording],
    model: str | Path | Model,
    choices: Choices,
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    estimator: str,
    seed: int,
    engine: Engine,
    progress: Callable[[str], None],
    warnings: list[str],
) -> Identification:
    """Do what `identify` says, leaving in `warnings` what was doubtful even if no answer comes."""
    prepared = choices.apply(build_model(robot, model))
    robot = prepared.robot
    if not prepared.parameters.free.any():
        raise InputError("every parameter is fixed; nothing is left to estimate")
    doubled: list[str] = []
    train_logs = each_once(train_logs, doubled)
    held_logs = each_once(without_trained(train_logs, asked_logs, doubled), doubled)
    gains = choices.gains(robot.actuated)
    factors = {joint: factor for joint, (factor, _) in gains.items()}
    data = Data(prepared, train_logs, preparation, exclude, factors, engine=engine, progress=progress)
    held_out = Data(prepared, held_logs, factors=factors, campaigns=tuple(log.name for log in train_logs), engine=engine,
                    progress=progress)  # fmt: skip
    refuse_in_blocks(estimator, data.streams)
    warnings += [*robot.warnings, *data.warnings(), *held_out.warnings(), *doubled]
    progress("columns")
    training = data.regression(prepared)
    _refuse_constant_forces(train_logs, training)
    warnings += _singularities(prepared, training)
    progress("structure")
    structural = structural_base(prepared, seed)
    better = Estimator(estimator, prepared, data.pieces, gains, warnings)
    solve = _Solver(prepared, structural, {j: sigma for j, (_, sigma) in gains.items()}, better)
    progress("estimate")
    training, estimate = settled(prepared, training, solve, data.regression, warnings)
    progress("held-out errors")
    if held_logs:
        held_out.preparation = training.settings["preparation"]
        held = held_out.regression(prepared.with_parameters(estimate.parameters))
        judged = force_errors(held, estimate.theta)
        how = "held-out logs: " + ", ".join(log.name for log in held_logs)
    else:
        held, judged, how = _judge_last_part(data, training, solve, bool(asked_logs), warnings)
    _refuse_if_nothing_determined(estimate)
    return Identification(
        model=replace(
            prepared.with_parameters(estimate.parameters), provenance=_provenance(train_logs, held_logs, seed)
        ),
        estimate=estimate,
        train=force_errors(training, estimate.theta),
        holdout=judged,
        holdout_how=how,
        held=held,
        nominal=prepared.parameters,
        friction=str(model) if isinstance(model, str) and model in FRICTION_MODELS else "",
        warnings=tuple(dict.fromkeys([*warnings, *doubts(estimate), *unlike_the_file(estimate, prepared.parameters)])),
        equivalent=equivalences(estimate, robot.actuated),
        seed=seed,
        logs=tuple(train_logs),
    )


def refuse_in_blocks(estimator: str, streams: bool) -> None:
    """Refuse estimators that look at all rows again and again, where the rows are on disk."""
    if streams and estimator not in ("wls", "auto"):
        raise InputError(
            f"estimator {estimator} needs all rows in memory, and a recording is too large; use wls, or give an excerpt"
        )


def build_model(robot: Robot, model: str | Path | Model) -> Model:
    """Return a model of this robot: friction by name, or the effects and values of a model file.

    Raises:
        InputError: The model file is of a robot with other actuated joints or parameters.
    """
    if isinstance(model, str) and model in FRICTION_MODELS:
        return Model.of(robot, friction_model(model, robot.actuated, robot.force_units))
    if not isinstance(model, Model):
        if isinstance(model, str) and not Path(model).suffix:
            friction_model(model, robot.actuated, robot.force_units)  # says which names there are
        model = Model.load(model)
    if model.robot.actuated != robot.actuated:
        theirs = ", ".join(model.robot.actuated)
        raise InputError(f"the model is of a robot with joints {theirs}; this one has {', '.join(robot.actuated)}")
    return model.on(robot)


@dataclass(frozen=True)
class _Solver:
    """The estimation of one model, whatever the data."""

    model: Model
    structural: BaseParameters
    gains: dict[str, float]
    better: Estimator

    def __call__(self, regression: Regression) -> Estimate:
        first = solve_least_squares(
            regression,
            physics=physics_of(self.model),
            structural=self.structural,
            gains=self.gains,
        )
        return self.better(first)


def _singularities(model: Model, regression: Regression) -> list[str]:
    found = []
    for run in regression.runs:
        found += model.mechanism.singularity_warnings(run.signals["q"][:: max(1, len(run.t) // 500)])
    return found


def _judge_last_part(
    data: Data, training: Regression, solve: _Solver, asked: bool, warnings: list[str]
) -> tuple[Regression | None, ForceErrors | None, str]:
    if asked:
        return None, None, "no held-out log was left"
    first, last, there = data.parts(training)
    try:
        estimate = solve(first)
    except CannotAnswer:
        warnings.append(
            "the first 70 % of the logs alone determine nothing, so there are no held-out errors; give --holdout"
        )
        return None, None, "the logs are too short to hold a part out"
    return (
        last if there else None,
        force_errors(last, estimate.theta),
        "last 30 % of each log, predicted by a fit of its first 70 %",
    )


def _refuse_if_nothing_determined(estimate: Estimate) -> None:
    """Refuse an estimate of which no base parameter is known to 30 %, and say what is missing."""
    if np.any(estimate.stderr < DETERMINED * np.abs(estimate.beta)):
        return
    raise CannotAnswer(
        "this motion determines no parameter, alone or in combination, to within 30 %",
        f"move {', '.join(estimate.regression.outputs)} in both directions over several speeds, accelerate more than the "
        "noise shows, and let the model have friction (--model asymmetric)",
    )


def _refuse_constant_forces(logs: list[Log | Recording], regression: Regression) -> None:
    """Refuse a force that is the same to the last bit while its joint moves: it was not measured."""
    here = [log for log in logs if isinstance(log, Log)]
    moving = [j for k, j in enumerate(regression.outputs) if any(run.usable[:, k].any() for run in regression.runs)]
    flat = [j for j in moving if len(here) == len(logs) and all(_flat(log, "tau", j) for log in here)]
    flat = [j for j in flat if not all(_flat(log, "q", j) for log in here)]
    if flat:
        raise CannotAnswer(
            f"the logged force of {', '.join(flat)} never changes", "log the drives' forces and repeat the motion"
        )


def _flat(log: Log, signal: str, joint: str) -> bool:
    return np.ptp(log.joint(signal, [joint])) == 0


def _provenance(train: list[Log | Recording], held: list[Log | Recording], seed: int) -> dict:
    from tau_dyn.version import __version__

    def rows(logs: list[Log | Recording]) -> list[dict[str, str]]:
        return [{"path": log.name, "sha256": log.sha256} for log in logs]

    return {"tool_version": __version__, "trained_on": rows(train), "held_out": rows(held), "seed": seed}
