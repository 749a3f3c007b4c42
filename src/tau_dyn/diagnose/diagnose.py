"""Measured logs and a model -> where the simulation is wrong, which physical cause explains it, and the gain.

    baseline refitted -> causes searched on the training part -> confirmed on the next -> gain measured on the last

No part of the data serves two purposes: what was searched is not what confirms, and neither measures the gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.deflection import diagnose_deflection
from tau_dyn.diagnose.encoders import chance_with_encoders, noise_only
from tau_dyn.diagnose.force import (
    ForceChannel,
    border_gap,
    clear_cutoff,
    diagnosis_preparation,
    force_channel,
    force_regression,
    prepared_pieces,
    smooth_cutoffs,
    thinned_log,
)
from tau_dyn.diagnose.limits import limits_of
from tau_dyn.diagnose.merge import merged
from tau_dyn.diagnose.nominal import parameter_findings
from tau_dyn.diagnose.resonances import with_band, with_resonances
from tau_dyn.diagnose.result import Diagnosis, Finding, Unexplained, Untestable, Verdict
from tau_dyn.diagnose.search import FAMILY_LEVEL, Search, columns_of, search
from tau_dyn.diagnose.stages import (
    HELD_OUT,
    SHARED,
    Answer,
    assembled,
    confirmed,
    effects_of,
    estimated,
    findings_of,
    told_from_zero,
    unexplained_of,
    waterfall,
)
from tau_dyn.diagnose.tool_diagnosis import diagnose_tool
from tau_dyn.diagnose.trials import DRAWS, Library
from tau_dyn.diagnose.unknown import Structure, find_structure, structure_chance
from tau_dyn.diagnose.within import heard, tests_of
from tau_dyn.diagnose.words import verdict_sentence
from tau_dyn.estimate import Physics, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import Choices, Identification
from tau_dyn.identify.identify import build_model
from tau_dyn.identify.logs import each_once, listed, log_warnings, without_trained
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.regression import even_pieces
from tau_dyn.identify.structure import physics_of
from tau_dyn.log import Log, Recording, encoder_noise
from tau_dyn.model import Model
from tau_dyn.robot import Robot

Progress = Callable[[str], None]
TOOL = ("x_tool", "y_tool", "z_tool")
_LOOKED_AT = 400
_ENCODERS = 3.0


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
            raise InputError("diagnose does not take --fix JOINT.drive_gain; scale the forces in the column map")
        given = each_once(listed(logs), warnings)
        train = in_memory(given)
        held = in_memory(each_once(without_trained(given, listed(holdout), warnings), warnings))
        if not train:
            raise InputError("no log was given")
        found = []
        if has_forces(prepared.robot, train) or not (has_tool(prepared.robot, train) or has_links(train)):
            case = _gather(prepared, train, held, preparation, exclude, progress, warnings)
            found.append(_diagnose(case, seed, progress, warnings))
        base = found[0].model if found else prepared
        if has_tool(base.robot, train) and (not found or tool_disagrees(base, train)):
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
        return _forces_missed(merged(found), prepared.robot, train)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


def in_memory(logs: Sequence[Log | Recording]) -> list[Log]:
    """Return logs that are in memory; a search looks at all of a log again and again."""
    odd = [log.name for log in logs if isinstance(log, Recording)]
    if odd:
        raise InputError(f"{odd[0]} is too large to be diagnosed at once; give an excerpt of some minutes")
    return [log for log in logs if isinstance(log, Log)]


def has_forces(robot: Robot, logs: Sequence[Log]) -> bool:
    """Tell whether all logs have the force of every actuated joint."""
    return all(log.has("tau", robot.actuated) for log in logs)


def _forces_missed(found: Diagnosis, robot: Robot, logs: Sequence[Log]) -> Diagnosis:
    """Say so where forces were not looked at, since some are not there."""
    if has_forces(robot, logs):
        return found
    missing = [f"tau_{j}" for j in robot.actuated if not all(log.has("tau", [j]) for log in logs)]
    sentence = f"forces were not looked at, only positions: the logs have no {', '.join(missing)}"
    return replace(found, warnings=(sentence, *found.warnings))


def has_tool(robot: Robot, logs: Sequence[Log]) -> bool:
    """Tell whether all logs have tool positions that forward kinematics can be held against."""
    return robot.tool_frame is not None and all(set(TOOL) <= set(log.channels) for log in logs)


def tool_disagrees(model: Model, logs: Sequence[Log]) -> bool:
    """Tell whether measured tools are farther from forward kinematics than the encoders' noise puts them.

    Where they are not, there is nothing to explain: the tool was computed from the encoders, or agrees with them.
    """
    joints = model.robot.actuated
    for log in logs:
        read = log.joint("q", joints)
        few = slice(None, None, max(1, log.n_samples // _LOOKED_AT))
        away = np.column_stack([log.channels[c][few] for c in TOOL]) - model.mechanism.tool_position(read[few])
        spread = float(np.sqrt(np.mean(np.sum((away - away.mean(axis=0)) ** 2, axis=1))))
        noise = model.mechanism.tool_jacobian(read[few]) * encoder_noise(read)
        if spread > _ENCODERS * float(np.sqrt(np.mean(np.sum(noise**2, axis=(1, 2))))):
            return True
    return False


def has_links(logs: Sequence[Log]) -> bool:
    """Tell whether all logs have link-side encoders."""
    return all(log.joints("q_link") for log in logs)


@dataclass(frozen=True, eq=False)
class _Case:
    """A baseline fitted to logs, ready to be doubted."""

    nominal: Model
    model: Model
    channel: Channel
    physics: Physics
    preparation: Preparation
    smooth_hz: tuple[float, ...]
    clear_hz: float
    held: tuple[bool, ...]
    pieces: tuple[Log, ...]
    how: str

    def noise_only(self, rng: np.random.Generator) -> Channel:
        """Return the channel of logs that hold nothing but the baseline and encoder noise."""
        assert isinstance(self.channel, ForceChannel)
        logs = noise_only(self.channel, self.model, self.pieces, self.smooth_hz, rng)
        prepared = prepared_pieces(self.nominal, logs, self.preparation, self.smooth_hz)
        regression = force_regression(self.nominal, prepared, self.preparation)
        return replace(
            force_channel(self.model, prepared, self.held, self.preparation, regression, self.clear_hz),
            parameters=self.nominal.parameters,
        )


def _gather(
    model: Model,
    train_logs: list[Log],
    held_logs: list[Log],
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    progress: Progress,
    warnings: list[str],
) -> _Case:
    train, held = ([piece for log in logs for piece in even_pieces(log)] for logs in (train_logs, held_logs))
    warnings += [*model.robot.warnings, *log_warnings(model.robot, [*train, *held])]
    preparation = preparation or diagnosis_preparation(model.robot, train, exclude)
    progress("columns")
    pieces = (*train, *held)
    smooth_hz, clear_hz = smooth_cutoffs(model.robot, train, held), clear_cutoff(model.robot, train)
    thinned = [thinned_log(piece, preparation.position_cutoff_hz) for piece in pieces]
    prepared = prepared_pieces(model, thinned, preparation, smooth_hz)
    regression = force_regression(model, prepared, preparation)
    physics = physics_of(model)
    progress("baseline")
    first = replace(regression, runs=regression.runs[: len(train)])
    estimate = solve_least_squares(first, physics=physics)
    fit = model.with_parameters(estimate.parameters)
    is_held = (*[False] * len(train), *[True] * len(held))
    channel = force_channel(fit, prepared, is_held, preparation, regression, clear_hz)
    how = (HELD_OUT if held else SHARED).format(what="logs")
    channel = replace(channel, parameters=model.parameters)
    return _Case(model, fit, channel, physics, preparation, smooth_hz, clear_hz, is_held, pieces, how)


def _diagnose(case: _Case, seed: int, progress: Progress, warnings: list[str]) -> Diagnosis:
    progress("looking for resonances")
    channel, rng = with_resonances(case.channel), np.random.default_rng(seed)
    assert isinstance(channel, ForceChannel)
    progress("looking for causes")
    hunt = search(channel, rng, progress)
    structure = find_structure(channel, hunt.ground, hunt.ground.draws(DRAWS, rng), FAMILY_LEVEL)
    if hunt.found or structure:
        progress("what encoder noise would do")
        hunt, structure = _sifted(case.noise_only(rng), hunt, structure)
    progress("confirming")
    rate = channel.prepared[0].log.rate_hz
    gap = border_gap(case.preparation, rate)
    tests = heard(channel, hunt, structure, tests_of(channel, hunt, structure), gap, rng)
    kept = confirmed(channel, hunt, tests.causes, physics=case.physics)
    progress("measuring the gain")
    nominal = case.nominal.parameters
    bars = waterfall(channel, kept, rng, nominal=nominal.values, physics=case.physics)
    if len(sure := told_from_zero(kept, bars.judgements[-1])) < len(kept):
        kept = sure
        bars = waterfall(channel, kept, rng, nominal=nominal.values, physics=case.physics)
    before, after = bars.judgements[0], bars.judgements[-1]
    findings = [with_band(f, case.clear_hz) for f in findings_of(channel, hunt, tests.causes, kept, bars, rng)]
    findings += parameter_findings(case.nominal, nominal, estimated(after))
    unexplained = unexplained_of(structure, tests.structure)
    limits, untestable = limits_of(channel, hunt, [f.cause for f in findings])
    verdict = _verdict(findings, unexplained)
    answer = Answer(
        verdict,
        verdict_sentence(verdict, findings, unexplained, before.errors, after.errors),
        case.how,
        findings,
        unexplained,
        limits,
        _with_drift(untestable, unexplained),
        _experiment(verdict, findings),
        warnings,
        {"preparation": case.preparation.to_dict()},
    )
    return assembled(channel, hunt, kept, bars, case.nominal, answer, seed)


def _sifted(clean: Channel, hunt: Search, structure: Structure | None) -> tuple[Search, Structure | None]:
    """Leave out what encoder noise alone could have made."""
    library, kept = Library(clean), []
    for one in hunt.found:
        others = effects_of([other for other in hunt.found if other is not one])
        chance = chance_with_encoders(clean, hunt.ground, one.candidate, columns_of(library, others))
        if chance * hunt.n_causes < FAMILY_LEVEL:
            kept.append(one)
    if structure is not None:
        found = columns_of(library, effects_of(hunt.found))
        if structure_chance(clean, hunt.ground, structure, found) > FAMILY_LEVEL:
            structure = None
    return replace(hunt, found=tuple(kept)), structure


def _with_drift(untestable: tuple[Untestable, ...], unexplained: tuple[Unexplained, ...]) -> tuple[Untestable, ...]:
    """Say that a residual that drifts in time may be warmth, where no temperature was logged."""
    drifts = [u.joint for u in unexplained if "t" in u.depends_on]
    if not drifts:
        return untestable
    why = f"the residual of {drifts[0]} drifts in time, and the logs give no temperature"
    return tuple(
        replace(u, why=why, experiment="log temp_JOINT or temp_room [degC] and repeat the motion from cold to warm")
        if u.cause == "thermal_drift"
        else u
        for u in untestable
    )


def _verdict(findings: Sequence[Finding], unexplained: tuple[Unexplained, ...]) -> Verdict:
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if parameters:
        return "cannot_tell" if any("drive_gain" in f.indistinguishable_from for f in parameters) else "named"
    return "unexplained" if any(u.status == "confirmed" for u in unexplained) else "nothing_found"


def _experiment(verdict: Verdict, findings: Sequence[Finding]) -> str:
    return next((f.experiment for f in findings if f.experiment), "") if verdict == "cannot_tell" else ""
