"""Torque logs -> masses and friction that can be trusted: the whole main path in one place.

    robot, logs -> Model -> Regression -> Estimate -> errors on data the fit never saw -> Identification

What is doubtful is said in sentences: what the motion does not determine, where physics held the answer, which
descriptions the data cannot tell apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tau_dyn.effects import FRICTION_MODELS, friction_model
from tau_dyn.estimate import DETERMINED, BaseParameters, Estimate, Regression, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.choices import Choices, scale_outputs
from tau_dyn.identify.doubts import doubts, equivalences
from tau_dyn.identify.errors import ForceErrors, force_errors
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.regression import build_regression, even_pieces
from tau_dyn.identify.result import Identification
from tau_dyn.identify.structure import physics_of, structural_base
from tau_dyn.log import Log, unit_warnings
from tau_dyn.model import Model
from tau_dyn.robot import Robot

_MOST = 4  # warnings about one log before they are counted instead of listed

TRAIN_SHARE = 0.7
"""Where no held-out log is given, a fit of this first part of each log predicts the rest."""


def identify(
    robot: Robot,
    logs: Log | Iterable[Log],
    *,
    holdout: Log | Iterable[Log] = (),
    model: str | Path | Model = "asymmetric",
    choices: Choices | None = None,
    preparation: Preparation | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Identification:
    """Identify a robot's parameters from torque logs.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `q_J` and `tau_J` of every actuated joint.
        holdout: Logs to judge on; without any, the last 30 % of each log, predicted by a fit of the first 70 %.
        model: `rigid`, `symmetric`, `asymmetric`, a model file, or a model.
        choices: What is fixed, free, bounded or measured beforehand.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of the random states of the structural study.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the model or a choice is at fault.
        CannotAnswer: The logs determine nothing.
    """
    warnings: list[str] = []
    try:
        return _identify(
            robot,
            _listed(logs),
            _listed(holdout),
            model,
            choices or Choices(),
            preparation,
            exclude,
            seed,
            progress,
            warnings,
        )
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


def _identify(
    robot: Robot,
    train_logs: list[Log],
    asked_logs: list[Log],
    model: str | Path | Model,
    choices: Choices,
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    seed: int,
    progress: Callable[[str], None],
    warnings: list[str],
) -> Identification:
    """Do what `identify` says, leaving in `warnings` what was doubtful even if no answer comes."""
    prepared = choices.apply(build_model(robot, model))
    robot = prepared.robot
    if not prepared.parameters.free.any():
        raise InputError("every parameter is fixed; nothing is left to estimate")
    doubled: list[str] = []
    train_logs = _each_once(train_logs, doubled)
    held_logs = _each_once(_without_trained(train_logs, asked_logs, doubled), doubled)
    train, held_out = ([piece for log in logs for piece in even_pieces(log)] for logs in (train_logs, held_logs))
    warnings += [*robot.warnings, *_log_warnings(robot, [*train, *held_out]), *doubled]
    gains = choices.gains(robot.actuated)

    progress("columns")
    training = _scaled(build_regression(prepared, train, preparation=preparation, exclude=exclude), gains)
    warnings += _singularities(prepared, training)
    progress("structure")
    structural = structural_base(prepared, seed)
    solve = _Solver(prepared, structural, {j: sigma for j, (_, sigma) in gains.items()})
    progress("estimate")
    estimate = solve(training)
    progress("held-out errors")
    if held_logs:
        held = _scaled(build_regression(prepared, held_out, preparation=training.settings["preparation"]), gains)
        judged = force_errors(held, estimate.theta)
        how = "held-out logs: " + ", ".join(log.name for log in held_logs)
    else:
        held, judged, how = _judge_last_part(training, solve, bool(asked_logs), warnings)
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
        warnings=tuple(dict.fromkeys([*warnings, *doubts(estimate)])),
        equivalent=equivalences(estimate, robot.actuated),
        seed=seed,
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

    def __call__(self, regression: Regression) -> Estimate:
        return solve_least_squares(
            regression,
            physics=physics_of(self.model),
            structural=self.structural,
            gains=self.gains,
        )


def _listed(logs: Log | Iterable[Log]) -> list[Log]:
    if isinstance(logs, Log):
        return [logs]
    if isinstance(logs, str | Path):
        raise InputError(f"{str(logs)[:80]} is a path, not a Log; read it with read_log(path)")
    return list(logs)


def _each_once(logs: list[Log], warnings: list[str]) -> list[Log]:
    """Return the logs without repetitions: the same samples twice would look like twice the evidence."""
    once: list[Log] = []
    for log in logs:
        if any(_shares_samples(log, other) for other in once):
            warnings.append(f"{log.name} is given twice, or overlaps with a log given before; it counts once")
        else:
            once.append(log)
    return once


def _log_warnings(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Return what is doubtful about the logs' pieces; of many alike from one file the first two and their number."""
    found: list[str] = []
    for name in dict.fromkeys(log.name for log in logs):
        pieces = [log for log in logs if log.name == name]
        said = list(dict.fromkeys(w for log in pieces for w in (*log.warnings, *unit_warnings(log, robot))))
        found += said if len(said) <= _MOST else [*said[:2], f"{name}: {len(said) - 2} more warnings like these"]
    return found


def _without_trained(train: list[Log], held: list[Log], warnings: list[str]) -> list[Log]:
    """Drop held-out logs that are also trained on, and say so; their errors would not be held-out errors."""
    both = [log for log in held if any(_shares_samples(log, other) for other in train)]
    for log in both:
        warnings.append(
            f"{log.name} is both trained on and held out; its errors are not held-out errors and are left out"
        )
    return [log for log in held if log not in both]


def _shares_samples(one: Log, other: Log) -> bool:
    """Return whether two logs hold the same samples; parts of one file that do not overlap in time are different data."""
    same_file = one is other or bool(one.sha256 and one.sha256 == other.sha256)
    return same_file and one.t[0] <= other.t[-1] and other.t[0] <= one.t[-1]


def _scaled(regression: Regression, gains: dict[str, tuple[float, float]]) -> Regression:
    return scale_outputs(regression, {joint: factor for joint, (factor, _) in gains.items()}) if gains else regression


def _singularities(model: Model, regression: Regression) -> list[str]:
    found = []
    for run in regression.runs:
        found += model.mechanism.singularity_warnings(run.signals["q"][:: max(1, len(run.t) // 500)])
    return found


def _judge_last_part(
    training: Regression, solve: _Solver, asked: bool, warnings: list[str]
) -> tuple[Regression | None, ForceErrors | None, str]:
    if asked:
        return None, None, "no held-out log was left"
    first, last = _split(training)
    try:
        estimate = solve(first)
    except CannotAnswer:
        warnings.append(
            "the first 70 % of the logs alone determine nothing, so there are no held-out errors; give --holdout"
        )
        return None, None, "the logs are too short to hold a part out"
    return last, force_errors(last, estimate.theta), "last 30 % of each log, predicted by a fit of its first 70 %"


def _split(regression: Regression) -> tuple[Regression, Regression]:
    """Cut each run in time, leaving a gap as wide as the filters' memory."""
    preparation: Preparation = regression.settings["preparation"]
    first, last = [], []
    for run in regression.runs:
        cut = int(TRAIN_SHARE * len(run.t))
        gap = int(np.ceil(preparation.rate_hz / preparation.force_cutoff_hz)) if len(run.t) > 1 else 0
        first.append(run.window(slice(0, cut)))
        last.append(run.window(slice(min(cut + gap, len(run.t) - 1), len(run.t))))
    return replace(regression, runs=tuple(first)), replace(regression, runs=tuple(last))


def _refuse_if_nothing_determined(estimate: Estimate) -> None:
    """Refuse an estimate of which no base parameter is known to 30 %, and say what is missing."""
    if np.any(estimate.stderr < DETERMINED * np.abs(estimate.beta)):
        return
    regression = estimate.regression
    flat = [j for k, j in enumerate(regression.outputs) if all(np.ptp(run.y_all[:, k]) == 0 for run in regression.runs)]
    if flat:
        raise CannotAnswer(
            f"the logged force of {', '.join(flat)} never changes", "log the drives' forces and repeat the motion"
        )
    raise CannotAnswer(
        "this motion determines no parameter, alone or in combination, to within 30 %",
        f"move {', '.join(regression.outputs)} in both directions over several speeds, accelerate more than the noise shows, "
        "and let the model have friction (--model asymmetric)",
    )


def _provenance(train: list[Log], held: list[Log], seed: int) -> dict:
    from tau_dyn.version import __version__

    def rows(logs: list[Log]) -> list[dict[str, str]]:
        return [{"path": log.name, "sha256": log.sha256} for log in logs]

    return {"tool_version": __version__, "trained_on": rows(train), "held_out": rows(held), "seed": seed}
