"""Measured logs and a model -> where the simulation is wrong, which physical cause explains it, and the gain.

    baseline refitted -> causes searched on the training part -> confirmed on the next -> gain measured on the last

No part of the data serves two purposes: what was searched is not what confirms, and neither measures the gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.encoders import chance_with_encoders, noise_only
from tau_dyn.diagnose.extend import Judged, extended_regression, fitted, gain_of, judged
from tau_dyn.diagnose.findings import finding_of, signature_of
from tau_dyn.diagnose.floor import noise_floor
from tau_dyn.diagnose.force import (
    ForceChannel,
    diagnosis_preparation,
    force_channel,
    force_regression,
    prepared_pieces,
    smooth_cutoff,
    thinned_log,
)
from tau_dyn.diagnose.limits import limits_of
from tau_dyn.diagnose.nominal import parameter_findings
from tau_dyn.diagnose.result import Diagnosis, Finding, Gain, Step, TimeTrace, Unexplained, Untestable, Verdict
from tau_dyn.diagnose.search import FAMILY_LEVEL, Found, Search, columns_of, search
from tau_dyn.diagnose.trials import DRAWS, Library
from tau_dyn.diagnose.unknown import Structure, find_structure, structure_chance
from tau_dyn.diagnose.words import verdict_sentence
from tau_dyn.effects import Effect
from tau_dyn.estimate import Physics, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import Choices, Identification
from tau_dyn.identify.identify import build_model
from tau_dyn.identify.logs import each_once, listed, log_warnings, without_trained
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.regression import even_pieces
from tau_dyn.identify.structure import physics_of
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

Progress = Callable[[str], None]


def diagnose(
    robot: Robot | Identification,
    logs: Log | Iterable[Log] = (),
    *,
    holdout: Log | Iterable[Log] = (),
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
        case = _gather(prepared, listed(logs), listed(holdout), preparation, exclude, progress, warnings)
        return _diagnose(case, seed, progress, warnings)
    except CannotAnswer as fault:
        fault.warnings = tuple(dict.fromkeys(warnings))
        raise


@dataclass(frozen=True, eq=False)
class _Case:
    """A baseline fitted to logs, ready to be doubted."""

    nominal: Model
    model: Model
    channel: Channel
    physics: Physics
    preparation: Preparation
    smooth_hz: float
    held: tuple[bool, ...]
    how: str

    def noise_only(self, rng: np.random.Generator) -> Channel:
        """Return the channel of logs that hold nothing but the baseline and encoder noise."""
        assert isinstance(self.channel, ForceChannel)
        logs = noise_only(self.channel, self.model, self.smooth_hz, rng)
        prepared = prepared_pieces(self.nominal, logs, self.preparation, self.smooth_hz)
        regression = force_regression(self.nominal, prepared, self.preparation)
        return replace(
            force_channel(self.model, prepared, self.held, self.preparation, regression),
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
    train_logs = each_once(train_logs, warnings)
    held_logs = each_once(without_trained(train_logs, held_logs, warnings), warnings)
    train, held = ([piece for log in logs for piece in even_pieces(log)] for logs in (train_logs, held_logs))
    if not train:
        raise InputError("no log was given")
    warnings += [*model.robot.warnings, *log_warnings(model.robot, [*train, *held])]
    preparation = preparation or diagnosis_preparation(model.robot, train, exclude)
    progress("columns")
    pieces = [thinned_log(piece, preparation.position_cutoff_hz) for piece in (*train, *held)]
    smooth_hz = smooth_cutoff(model.robot, train)
    prepared = prepared_pieces(model, pieces, preparation, smooth_hz)
    regression = force_regression(model, prepared, preparation)
    physics = physics_of(model)
    progress("baseline")
    first = replace(regression, runs=regression.runs[: len(train)])
    estimate = solve_least_squares(first, physics=physics)
    fit = model.with_parameters(estimate.parameters)
    is_held = (*[False] * len(train), *[True] * len(held))
    channel = force_channel(fit, prepared, is_held, preparation, regression)
    how = (
        "held-out logs, blocks in turn: one half confirms, the other measures the gain"
        if held
        else "60 % of each log trains, 20 % confirms, 20 % measures the gain, in blocks that take turns"
    )
    channel = replace(channel, parameters=model.parameters)
    return _Case(model, fit, channel, physics, preparation, smooth_hz, is_held, how)


def _diagnose(case: _Case, seed: int, progress: Progress, warnings: list[str]) -> Diagnosis:
    channel, rng = case.channel, np.random.default_rng(seed)
    progress("looking for causes")
    hunt = search(channel, rng, progress)
    structure = find_structure(channel, hunt.ground, hunt.ground.draws(DRAWS, rng), FAMILY_LEVEL)
    if hunt.found or structure:
        progress("what encoder noise would do")
        hunt, structure = _sifted(case.noise_only(rng), hunt, structure)
    progress("confirming")
    tests = [_confirmation(channel, hunt, one) for one in hunt.found]
    kept = [one for one, test in zip(hunt.found, tests, strict=True) if test.holds]
    progress("measuring the gain")
    steps, judgements, gains = _waterfall(case, kept, hunt, rng)
    baseline, extended = judgements[0], judgements[-1]
    findings = _findings(case, hunt, tests, kept, judgements, gains)
    assert extended.estimate is not None
    findings += parameter_findings(case.nominal, case.nominal.parameters, extended.estimate)
    unexplained = _unexplained(channel, hunt, structure)
    limits, untestable = limits_of(channel, hunt, [f.cause for f in findings])
    untestable = _with_drift(untestable, unexplained)
    verdict = _verdict(findings, unexplained)
    floor = noise_floor(channel, hunt, extended, rng)
    effects = tuple(e for one in kept for e in one.candidate.effects)
    extended_model = _model_of(case.nominal, extended, effects)
    assert baseline.estimate is not None
    return Diagnosis(
        verdict=verdict,
        sentence=verdict_sentence(verdict, findings, unexplained, baseline.errors, extended.errors),
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=baseline.errors,
        extended=extended.errors,
        noise_floor=floor,
        waterfall=(*steps, Step("noise_floor", floor)),
        findings=tuple(sorted(findings, key=_strength)),
        unexplained=unexplained,
        limits=limits,
        untestable=untestable,
        model=_model_of(case.nominal, baseline, ()),
        extended_model=extended_model,
        traces=_traces(channel, baseline, extended),
        n_parts=_seconds(channel),
        how=case.how,
        warnings=tuple(dict.fromkeys(warnings)),
        seed=seed,
        experiment=_experiment(verdict, findings),
        settings={
            "preparation": case.preparation.to_dict(),
            "noise_draws": DRAWS,
            "family_level": FAMILY_LEVEL,
            "causes_tried": hunt.n_causes,
        },
    )


def _sifted(clean: Channel, hunt: Search, structure: Structure | None) -> tuple[Search, Structure | None]:
    """Leave out what encoder noise alone could have made."""
    library, kept = Library(clean), []
    for one in hunt.found:
        others = [e for other in hunt.found if other is not one for e in other.candidate.effects]
        chance = chance_with_encoders(clean, hunt.ground, one.candidate, columns_of(library, others))
        if chance * hunt.n_causes < FAMILY_LEVEL:
            kept.append(one)
    if structure is not None:
        found = columns_of(library, [e for one in hunt.found for e in one.candidate.effects])
        if structure_chance(clean, hunt.ground, structure, found) > FAMILY_LEVEL:
            structure = None
    return replace(hunt, found=tuple(kept)), structure


def _confirmation(channel: Channel, hunt: Search, one: Found) -> Confirmation:
    others = [e for other in hunt.found if other is not one for e in other.candidate.effects]
    mine = columns_of(hunt.library, one.candidate.effects)
    return confirm(channel, hunt.noise, mine, columns_of(hunt.library, others))


def _waterfall(
    case: _Case, kept: list[Found], hunt: Search, rng: np.random.Generator
) -> tuple[list[Step], list[Judged], list[Gain]]:
    """Return the bars, the fits behind all but the first, and each cause's gain over the bar before it."""
    channel = case.channel
    plain = extended_regression(channel, ())
    steps = [Step("nominal", judged(channel, plain, case.nominal.parameters.values, None, rng).errors)]
    judgements = [fitted(channel, (), case.physics, rng)]
    steps.append(Step("refitted", judgements[0].errors))
    effects: list[Effect] = []
    gains = []
    for one in kept:
        effects += one.candidate.effects
        judgements.append(fitted(channel, effects, case.physics, rng))
        joints = list(dict.fromkeys(j for e in one.candidate.effects for j in e.joints))
        steps.append(Step(f"{one.candidate.cause} {' '.join(joints)}", judgements[-1].errors))
        gains.append(gain_of(channel, judgements[-2].residuals, judgements[-1].residuals, joints, rng))
    return steps, judgements, gains


def _findings(
    case: _Case,
    hunt: Search,
    tests: list[Confirmation],
    kept: list[Found],
    judgements: list[Judged],
    gains: list[Gain],
) -> tuple[Finding, ...]:
    found = []
    rng = np.random.default_rng(0)
    for one, test in zip(hunt.found, tests, strict=True):
        effects = one.candidate.effects
        if one in kept:
            final, gain = judgements[-1], gains[kept.index(one)]
        else:
            final, gain = (
                fitted(case.channel, [e for k in kept for e in k.candidate.effects] + list(effects), None, rng),
                None,
            )
        assert final.estimate is not None
        names = [n for e in effects for n in e.parameters.names]
        values = Parameters([p for p in final.estimate.parameters if p.name in names])
        signature = signature_of(case.channel, effects, final.residuals, values)
        found.append(finding_of(case.channel, hunt, one, test, values, gain, signature))
    return tuple(found)


def _unexplained(channel: Channel, hunt: Search, structure: Structure | None) -> tuple[Unexplained, ...]:
    if structure is None:
        return ()
    others = columns_of(hunt.library, [e for one in hunt.found for e in one.candidate.effects])
    test = confirm(channel, hunt.noise, [structure.columns], others)
    return (
        Unexplained(
            structure.output,
            structure.variables,
            structure.share,
            structure.formula,
            structure.p_value,
            "confirmed" if test.holds else "suspected",
        ),
    )


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


def _strength(finding: Finding) -> tuple[bool, bool, float]:
    """Order findings: confirmed ones first, by how much they take off the held-out error; the rest by score."""
    gain = finding.gain
    worth = gain.rms_before**2 - gain.rms_after**2 if gain is not None else 0.0
    return finding.status == "parameter", finding.status == "suspected", -worth if gain is not None else -finding.score


def _verdict(findings: tuple[Finding, ...], unexplained: tuple[Unexplained, ...]) -> Verdict:
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if parameters:
        return "cannot_tell" if any("drive_gain" in f.indistinguishable_from for f in parameters) else "named"
    return "unexplained" if any(u.status == "confirmed" for u in unexplained) else "nothing_found"


def _experiment(verdict: Verdict, findings: tuple[Finding, ...]) -> str:
    return next((f.experiment for f in findings if f.experiment), "") if verdict == "cannot_tell" else ""


def _model_of(nominal: Model, fit: Judged, effects: tuple[Effect, ...]) -> Model:
    """Return the model with further effects at fitted values."""
    assert fit.estimate is not None
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(
        nominal, effects=(*nominal.effects, *effects), effect_parameters=nominal.effect_parameters + more
    )
    return extended.with_parameters(fit.estimate.parameters)


def _traces(channel: Channel, baseline: Judged, extended: Judged) -> tuple[TimeTrace, ...]:
    found = []
    for k, run in enumerate(channel.runs):
        before, after = (j.regression.runs[k].W_all @ j.theta for j in (baseline, extended))
        found.append(TimeTrace(run.name, run.t, run.y_all, before, after, run.usable, channel.parts[k]))
    return tuple(found)


def _seconds(channel: Channel) -> tuple[float, float, float]:
    """Return how long each part is [s]."""
    steps = [float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0 for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == number)) for dt, part in zip(steps, channel.parts, strict=True))
        for number in range(3)
    )
    return one, two, three
