"""Measured logs and a model -> errors of the simulation, the physical causes that explain them, and the gain.

    baseline refitted -> causes searched on the training part -> confirmed on the next -> gain measured on the last

No part of the data serves two purposes: the search, the confirmation and the gain use different parts, and each part can
reject: a cause that does not predict its part better is not confirmed. Logs may hold several kinds of measurement: forces, tool
positions with more information than the encoders, encoders behind the gear. Forces take precedence: baseline, waterfall and
time view are theirs; a finding states its channel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from tau_dyn.diagnose.force_baseline import Progress, fit_baseline
from tau_dyn.diagnose.pipeline import diagnose_deflection, diagnose_forces, diagnose_tool
from tau_dyn.diagnose.tool_channel import OUTPUTS
from tau_dyn.effects import Effect, JointwiseEffect
from tau_dyn.evidence import (
    Choice,
    Diagnosis,
    Verdict,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import (
    Choices,
    Identification,
    Preparation,
    build_model,
    complete_positions,
    drop_repeated_logs,
    get_log_list,
    list_provenance,
    require_forces,
)
from tau_dyn.legged import complete_base, list_base_warnings
from tau_dyn.log import Log, Recording, estimate_encoder_noise
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot
from tau_dyn.simulate import CascadeLaw, Replay, replay

_LOOKED_AT = 400  # samples of a log for which forward kinematics is computed; bounds time
_ENCODERS = 3.0  # standard deviations of the encoders' noise


def has_forces(robot: Robot, logs: Sequence[Log]) -> bool:
    """Return whether all logs have the force of every actuated joint."""
    return all(log.has("tau", robot.actuated) for log in logs)


def has_tool(robot: Robot, logs: Sequence[Log]) -> bool:
    """Return whether all logs have tool positions that can be compared with forward kinematics."""
    return robot.tool_frame is not None and all(set(OUTPUTS) <= set(log.channels) for log in logs)


def is_tool_inconsistent(model: Model, logs: Sequence[Log]) -> bool:
    """Return whether measured tool positions differ from forward kinematics by more than the encoders' noise explains.

    If not, there is no error to explain: the tool position was computed from the encoders, or agrees with them.
    """
    joints = model.robot.actuated
    for log in logs:
        read = log.joint("q", joints)
        few = slice(None, None, max(1, log.n_samples // _LOOKED_AT))
        away = np.column_stack([log.channels[c][few] for c in OUTPUTS]) - model.mechanism.tool_position(read[few])
        spread = float(np.sqrt(np.mean(np.sum((away - away.mean(axis=0)) ** 2, axis=1))))
        noise = model.mechanism.tool_jacobian(read[few]) * estimate_encoder_noise(read)
        if spread > _ENCODERS * float(np.sqrt(np.mean(np.sum(noise**2, axis=(1, 2))))):
            return True
    return False


_VERDICTS: tuple[Verdict, ...] = ("named", "cannot_tell", "unexplained", "nothing_found")
_CHOICES: tuple[Choice, ...] = ("neither", "extended", "refitted")
"""The verdict of one channel applies to the whole diagnosis, in this order of precedence."""


def merge_diagnoses(found: Sequence[Diagnosis]) -> Diagnosis:
    """Return the diagnoses of several channels as one; the first takes precedence."""
    first, others = found[0], found[1:]
    if not others:
        return first
    limits = {limit.cause: limit for one in reversed(found) for limit in one.limits}
    findings = sorted(
        (f for one in found for f in one.findings), key=lambda f: (*f.rank[:2], f.channel != first.channel)
    )
    named = {f.cause for f in findings}
    untestable = {u.cause: u for one in reversed(found) for u in one.untestable}
    recommended = min(found, key=lambda one: _CHOICES.index(one.recommendation))
    told = [one for one in others if one.verdict != "nothing_found"]
    return replace(
        first,
        verdict=min((one.verdict for one in found), key=_VERDICTS.index),
        recommendation=recommended.recommendation,
        recommendation_why=recommended.recommendation_why,
        sentence=" ".join([first.sentence, *(one.sentence for one in told)]),
        findings=tuple(findings),
        unexplained=tuple(u for one in found for u in one.unexplained),
        limits=tuple(x for cause, x in sorted(limits.items()) if cause not in named),
        untestable=tuple(u for cause, u in untestable.items() if cause not in limits and cause not in named),
        extended_model=_extended(first, others),
        warnings=tuple(dict.fromkeys(w for one in found for w in one.warnings)),
        experiment=next((one.experiment for one in found if one.experiment), ""),
        settings={**first.settings, **{one.channel: dict(one.settings) for one in others}},
    )


def _extended(first: Diagnosis, others: Sequence[Diagnosis]) -> Model:
    """Return the first channel's extended model with the effects that the others add."""
    model = first.extended_model
    for one in others:
        known = {name for e in model.effects for name in e.parameters.names}
        parts = (_only_unknown(e, known) for e in one.extended_model.effects)
        new = [e for e in parts if e is not None]
        names = [n for e in new for n in e.parameters.names]
        values = one.extended_model.effect_parameters.select(names)
        model = replace(
            model, effects=(*model.effects, *new), effect_parameters=model.effect_parameters + Parameters(list(values))
        )
    return model


def _only_unknown(effect: Effect, known: set[str]) -> Effect | None:
    """Return an effect on the joints on which the model does not have it yet; the first channel's values are kept."""
    if not known & set(effect.parameters.names):
        return effect
    joints = [
        j for j in effect.joints if not any(name.startswith(f"{j}.") for name in known & set(effect.parameters.names))
    ]
    if not joints or not isinstance(effect, JointwiseEffect):
        return None
    left = type(effect)(joints, [effect.units[j] for j in joints], label=effect.label, **effect.settings)
    return None if known & set(left.parameters.names) else left


def log_with_references(logs: Sequence[Log], joints: Sequence[str]) -> Log:
    """Return the first log that holds the references of its controller.

    Raises:
        InputError: No log holds them.
    """
    for log in logs:
        if log.has("q_ref", joints):
            return log
    raise InputError(
        "missing_column",
        f"none of {', '.join(log.name for log in logs)} has q_ref columns for {', '.join(joints)}; without references no closed "
        "loop can be simulated, so leave the controller out or add them",
    )


def add_simulation(
    diagnosis: Diagnosis, logs: Sequence[Log], law: CascadeLaw, progress: Callable[[str], None] = lambda step: None
) -> Diagnosis:
    """Return a diagnosis with `simulation`: the error of the closed loop against a log, before and after the extension.

    Args:
        diagnosis: The diagnosis, with both models.
        logs: Training logs; the first with `q_ref_J` is simulated.
        law: The rig's own controller.
        progress: Called with a word for each step.

    Raises:
        InputError: No log has references, or the simulated loop is unstable.
    """
    log = log_with_references(logs, diagnosis.model.robot.actuated)
    models = {"before": diagnosis.model, "after": diagnosis.extended_model}
    done: dict[str, Replay] = {}
    for when, model in models.items():
        if when == "after" and len(model.effects) == len(diagnosis.model.effects):
            done[when] = done["before"]  # no cause was added
            continue
        done[when] = replay(model, log, law, progress=lambda share: progress(f"simulating {100 * share:.0f} %"))
    doubts = tuple(dict.fromkeys([*diagnosis.warnings, *(w for run in done.values() for w in run.warnings)]))
    simulation = {"log": log.name, **{when: run.to_dict() for when, run in done.items()}}
    return replace(diagnosis, simulation=simulation, warnings=doubts)


@threadpool_limits.wrap(limits=1)  # many narrow matrices: more threads only wait for each other
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
    """Find the errors of a simulation and their physical causes.

    Args:
        robot: The robot, or an identification, whose model and logs are then used.
        logs: Logs to train on, with `q_J` and `tau_J` of every actuated joint.
        holdout: Logs for confirming and for measuring the gain; by default, blocks of the logs are held out (60/20/20).
        model: The baseline: `rigid`, `symmetric`, `asymmetric`, a model file, or a model.
        choices: Parameters that are fixed, free, bounded or measured beforehand.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.

    Raises:
        InputError: A log, the model or a choice is at fault.
        CannotAnswer: The logs determine no parameter, or are too short for three parts.
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
        given, judged, doubled = drop_repeated_logs(
            *(complete_positions(prepared.robot, get_log_list(some)) for some in (logs, holdout))
        )
        warnings += doubled
        train, held = load_into_memory(given), load_into_memory(judged)
        if not train:
            raise InputError("missing_input", "no log was given")
        if walks := bool(prepared.robot.base_coordinates):
            require_forces(prepared.robot, train)
            warnings += list_base_warnings(prepared.robot, [*train, *held])
            train, held = (complete_base(prepared.robot, some) for some in (train, held))
        tool, links, forces = (
            not walks and has_tool(prepared.robot, train),
            not walks and all(log.joints("q_link") for log in train),
            has_forces(prepared.robot, train),
        )
        if not (tool or links):
            require_forces(prepared.robot, train)
        found: list[Diagnosis] = []
        if forces or not (tool or links):
            case = fit_baseline(prepared, train, held, preparation, exclude, progress)
            found.append(diagnose_forces(case, seed=seed, progress=progress, warnings=warnings))
        base, doubts = (found[0].model, ()) if found else (prepared, warnings)
        if tool and (not found or is_tool_inconsistent(base, train)):
            with_tool = [log for log in held if has_tool(base.robot, [log])]
            try:
                found.append(
                    diagnose_tool(base, train, holdout=with_tool, seed=seed, progress=progress, warnings=doubts)
                )
            except CannotAnswer as fault:
                if not found:
                    raise
                more = f"tool positions were not looked at: {fault.missing}"  # forces are diagnosed
                found[0] = replace(found[0], warnings=(*found[0].warnings, more))
        if links:
            found.append(
                diagnose_deflection(base.robot, train, holdout=held, seed=seed, progress=progress, warnings=doubts)
            )
        merged = _with_provenance(merge_diagnoses(found), train, held)
        return _forces_missed(merged, prepared.robot, train)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys((*warnings, *fault.warnings)))
        raise


def _with_provenance(found: Diagnosis, train: Sequence[Log], held: Sequence[Log]) -> Diagnosis:
    """Return a diagnosis whose two models name their logs."""
    source = list_provenance(train, held, found.seed)
    model, extended = (replace(one, provenance=source) for one in (found.model, found.extended_model))
    return replace(found, model=model, extended_model=extended)


def load_into_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs in memory; a search reads all samples of a log repeatedly."""
    odd = [log.name for log in logs if isinstance(log, Recording)]
    if odd:
        raise InputError(
            "file_too_large", f"{odd[0]} is too large to be diagnosed at once; give an excerpt of some minutes"
        )
    return [log for log in logs if isinstance(log, Log)]


def _forces_missed(found: Diagnosis, robot: Robot, logs: Sequence[Log]) -> Diagnosis:
    """Add a warning if forces were not diagnosed because some of them are missing."""
    if has_forces(robot, logs):
        return found
    missing = [f"tau_{j}" for j in robot.actuated if not all(log.has("tau", [j]) for log in logs)]
    sentence = f"forces were not looked at, only positions: the logs have no {', '.join(missing)}"
    return replace(found, warnings=(sentence, *found.warnings))
