"""Measured logs and a model -> where the simulation is wrong, which physical cause explains it, and the gain.

    baseline refitted -> causes searched on the training part -> confirmed on the next -> gain measured on the last

No part of the data serves two purposes: what was searched is not what confirms, and neither measures the gain, which has a
veto: what does not predict its part better does not stand.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from tau_dyn.diagnose.deflection import diagnose_deflection
from tau_dyn.diagnose.force_diagnosis import Progress, diagnose_forces, fit_baseline
from tau_dyn.diagnose.kinds import has_forces, has_links, has_tool, is_tool_inconsistent
from tau_dyn.diagnose.merge import merge_diagnoses
from tau_dyn.diagnose.result import Diagnosis
from tau_dyn.diagnose.tool_diagnosis import diagnose_tool
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import (
    Choices,
    Identification,
    Preparation,
    build_model,
    drop_repeated_logs,
    get_log_list,
    require_forces,
)
from tau_dyn.log import Log, Recording
from tau_dyn.model import Model
from tau_dyn.robot import Robot


@threadpool_limits.wrap(limits=1)  # its matrices are many and narrow: more threads only wait for each other
def diagnose(
    robot: Robot | Identification,
    logs: Log | Recording | Iterable[Log | Recording] = (),
    *,
    holdout: Log | Recording | Iterable[Log | Recording] = (),
    model: str | Path | Model = "asymmetric",
    choices: Choices | None = None,
    preparation: Preparation | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Progress = lambda step: None,
) -> Diagnosis:
    """Find out what a simulation gets wrong, and why.

    Args:
        robot: The robot, or an identification, whose model and logs are then taken.
        logs: Logs to train on, with `q_J` and `tau_J` of every actuated joint.
        holdout: Logs for confirming and for measuring the gain; without any, blocks of the logs are set aside (60/20/20).
        model: The baseline: `rigid`, `symmetric`, `asymmetric`, a model file, or a model.
        choices: What is fixed, free, bounded or measured beforehand.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the model or a choice is at fault.
        CannotAnswer: The logs determine nothing, or are too short for three parts.
    """
    if isinstance(robot, Identification):
        logs, model, robot = logs or robot.logs, robot.model.with_parameters(robot.nominal), robot.model.robot
    warnings: list[str] = []
    try:
        prepared = (choices or Choices()).apply(build_model(robot, model))
        if (choices or Choices()).gains(prepared.robot.actuated):
            raise InputError(
                "bad_option", "diagnose does not take --fix JOINT.drive_gain; scale the forces in the column map"
            )
        given, judged, doubled = drop_repeated_logs(get_log_list(logs), get_log_list(holdout))
        warnings += doubled
        train, held = load_into_memory(given), load_into_memory(judged)
        if not train:
            raise InputError("missing_input", "no log was given")
        found = []
        if not (has_tool(prepared.robot, train) or has_links(train)):
            require_forces(prepared.robot, train)
        if has_forces(prepared.robot, train) or not (has_tool(prepared.robot, train) or has_links(train)):
            case = fit_baseline(prepared, train, held, preparation, exclude, progress, warnings)
            found.append(diagnose_forces(case, seed, progress, warnings))
        base = found[0].model if found else prepared
        if has_tool(base.robot, train) and (not found or is_tool_inconsistent(base, train)):
            with_tool = [log for log in held if has_tool(base.robot, [log])]
            try:
                found.append(diagnose_tool(base, train, holdout=with_tool, seed=seed, progress=progress))
            except CannotAnswer as fault:
                if not found:
                    raise
                more = f"tool positions were not looked at: {fault.missing}"  # forces have their answer
                found[0] = replace(found[0], warnings=(*found[0].warnings, more))
        if has_links(train):
            found.append(diagnose_deflection(base.robot, train, holdout=held, seed=seed, progress=progress))
        return _forces_missed(merge_diagnoses(found), prepared.robot, train)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


def load_into_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs that are in memory; a search looks at all of a log again and again."""
    odd = [log.name for log in logs if isinstance(log, Recording)]
    if odd:
        raise InputError(
            "file_too_large", f"{odd[0]} is too large to be diagnosed at once; give an excerpt of some minutes"
        )
    return [log for log in logs if isinstance(log, Log)]


def _forces_missed(found: Diagnosis, robot: Robot, logs: Sequence[Log]) -> Diagnosis:
    """Say so where forces were not looked at, since some are not there."""
    if has_forces(robot, logs):
        return found
    missing = [f"tau_{j}" for j in robot.actuated if not all(log.has("tau", [j]) for log in logs)]
    sentence = f"forces were not looked at, only positions: the logs have no {', '.join(missing)}"
    return replace(found, warnings=(sentence, *found.warnings))
