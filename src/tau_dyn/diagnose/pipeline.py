"""One kind of measurement -> its diagnosis: causes searched, confirmed and measured, each on data of its own.

    channel -> null model, candidate scan, stepwise selection -> confirmation -> claims with their gain -> diagnosis

Forces, tool positions and deflections take the same way. Of forces the baseline stays physical, its parameters are held against
their nominal values, and a cause has to be more than what encoder noise makes of itself. Of poses a cyclic error may have several
periods that fit alike. A single joint's deflection and a tool have no mass that must stay positive and no nominal value.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tau_dyn.diagnose.deflection_channel import build_deflection_channel
from tau_dyn.diagnose.force_baseline import FittedBaseline, Progress
from tau_dyn.diagnose.loads import add_loads, find_loads, list_load_warnings, report_loads
from tau_dyn.diagnose.nominal import find_parameter_changes
from tau_dyn.diagnose.preparation import compute_border_gap_s
from tau_dyn.diagnose.resonances import add_band_note, add_resonances
from tau_dyn.diagnose.result import (
    Diagnosis,
)
from tau_dyn.diagnose.tool_channel import build_tool_channel
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.evidence import (
    EVERY,
    FAMILY_LEVEL,
    MAX_LAW_ERROR,
    N_BOOTSTRAP_DRAWS,
    N_NULL_DRAWS,
    Channel,
    Claims,
    ConfirmationResults,
    EvaluatedFit,
    Finding,
    NoiseOnlyBootstrap,
    Recommendation,
    Step,
    StepwiseSelection,
    Structure,
    TimeTrace,
    Unexplained,
    Untestable,
    Verdict,
    Waterfall,
    build_effects,
    build_findings,
    build_unexplained,
    compute_detection_limits,
    compute_least_forces,
    compute_structure_p_value,
    confirm_all,
    confirm_within_training,
    demote_small,
    describe_diagnosis,
    divide_training,
    estimate_noise_floor,
    find_alias_periods,
    find_structure,
    fit_extended_model,
    leave_period_open,
    measure_net_forces,
    recommend,
    select_causes,
    select_confirmed,
    select_supported,
)
from tau_dyn.exceptions import InputError
from tau_dyn.identify import drop_repeated_logs, is_diagnosis_invalid
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

HELD_OUT = "the blocks of the held-out {what} alternate: half are validation data, half are test data"
SHARED = "the blocks of the {what} alternate: 60 % training, 20 % validation and 20 % test data"
_MEND = "mend the log or its column map as the first warning says, or record it again"


def diagnose_forces(
    case: FittedBaseline, *, seed: int = 0, progress: Progress = lambda step: None, warnings: Sequence[str] = ()
) -> Diagnosis:
    """Find causes of what a fitted baseline leaves of the forces."""
    progress("looking for resonances")
    channel, how = add_resonances(case.channel), (HELD_OUT if any(case.held) else SHARED).format(what="logs")
    warnings = (*warnings, *case.warnings)
    return diagnose_channel(channel, case.nominal, how, seed=seed, progress=progress, warnings=warnings, case=case)


def diagnose_tool(
    model: Model,
    logs: Iterable[Log],
    *,
    holdout: Iterable[Log] = (),
    seed: int = 0,
    progress: Progress = lambda step: None,
    warnings: Sequence[str] = (),
) -> Diagnosis:
    """Find out what displaces the tool; options and errors are those of `diagnose`.

    Args:
        model: Its robot's geometry gives forward kinematics, its masses the loads.
        logs: Logs with `q_J` and `x_tool y_tool z_tool`, sampled in time or poses held still.
        holdout: Held-out logs.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: What was doubtful before.
    """
    train, held = list(logs), list(holdout)
    progress("columns")
    channel = add_resonances(build_tool_channel(model, train, held))
    how = (HELD_OUT if held else SHARED).format(what="poses" if channel.poses else "logs")
    return diagnose_channel(channel, model, how, seed=seed, progress=progress, warnings=warnings)


def diagnose_deflection(
    robot: Robot,
    logs: Log | Iterable[Log],
    *,
    holdout: Log | Iterable[Log] = (),
    causes: Sequence[type[Effect]] | None = None,
    seed: int = 0,
    progress: Progress = lambda step: None,
    warnings: Sequence[str] = (),
) -> Diagnosis:
    """Find out what comes between the two encoders of a joint; options and errors are those of `diagnose`.

    Args:
        robot: Names the joints; its masses play no part.
        logs: Logs to train on, with `q_J`, `tau_J` and `q_link_J` of the same joints.
        holdout: Held-out logs.
        causes: Causes that may be found; by default all that come between two encoders.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: What was doubtful before.
    """
    given, judged = ([x] if isinstance(x, Log) else list(x) for x in (logs, holdout))
    train, held, doubled = drop_repeated_logs(given, judged)
    said = [*warnings, *doubled]
    if not train:
        raise InputError("missing_input", "no log was given")
    progress("columns")
    channel = build_deflection_channel(robot, train, held, causes)
    how = (HELD_OUT if held else SHARED).format(what="logs")
    return diagnose_channel(channel, Model.of(robot), how, seed=seed, progress=progress, warnings=said)


def diagnose_channel(
    channel: Channel,
    model: Model,
    how: str,
    *,
    seed: int = 0,
    progress: Progress = lambda step: None,
    warnings: Sequence[str] = (),
    case: FittedBaseline | None = None,
) -> Diagnosis:
    """Find causes on a channel.

    Args:
        channel: The measurements.
        model: The model before any fit, which is extended by what is found.
        how: How the data are divided, in words.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: What was doubtful before.
        case: Of forces, the fitted baseline behind the channel.
    """
    rng = np.random.default_rng(seed)
    spoiled = _describe_spoiled(warnings) if case else ""
    progress("looking for causes")
    noise = case and _build_bootstrap(case, rng)
    hunt, structure = _search(channel, rng, progress, noise)
    loads = find_loads(case, channel, build_effects(hunt.found), np.random.default_rng(seed)) if case else []
    without = None
    if case and not spoiled and any(one.is_confirmed for one in loads):
        without = fit_extended_model(channel, (), case.physics, np.random.default_rng(seed)).errors
        case = add_loads(case, loads)
        channel = case.carry_loads(channel, case.channel.prepared)
        noise = _build_bootstrap(case, rng)
        hunt, structure = _search(channel, rng, progress, noise)
    physics, nominal = (case.physics, case.pad_nominal()) if case else (None, None)
    progress("confirming")
    tests = confirm_all(hunt, structure)
    aside: Sequence[np.ndarray] = ()
    if case and noise:
        gap_s = compute_border_gap_s(case.preparation.force_cutoff_hz, case.channel.prepared[0].log.rate_hz)
        tests = confirm_within_training(hunt, tests, gap_s, rng, noise)
        aside = divide_training(channel.runs, channel.parts, gap_s)
    periods = find_alias_periods(hunt)
    claims = _doubt(select_confirmed(hunt, tests.causes, physics), periods, spoiled)
    progress("measuring the gain")
    claims, bars = select_supported(hunt, claims, rng, nominal, physics, aside)
    found = _Found(hunt, claims, bars, tests, periods, spoiled)
    findings, unexplained = _tell(found, model, case, rng)
    warnings = (*warnings, *(list_load_warnings(loads) if without else ()))
    answer = _answer(found, findings, unexplained, model, case, rng, seed=seed, how=how, warnings=warnings)
    return report_loads(answer, loads, without)


def _build_bootstrap(case: FittedBaseline, rng: np.random.Generator) -> NoiseOnlyBootstrap:
    """Return what encoder noise alone makes of a baseline's logs."""
    return NoiseOnlyBootstrap(lambda: [case.noise_only(rng) for _ in range(N_BOOTSTRAP_DRAWS)])


class _Found(NamedTuple):
    """What search, confirmation and measurement left: `spoiled` says why nothing of it may be confirmed, or is empty."""

    hunt: StepwiseSelection
    claims: Claims
    bars: Waterfall
    tests: ConfirmationResults
    periods: Sequence[tuple[float, ...]]
    spoiled: str


def _search(
    channel: Channel, rng: np.random.Generator, progress: Progress, noise: NoiseOnlyBootstrap | None
) -> tuple[StepwiseSelection, Structure | None]:
    """Return the causes that the training part shows, and a structure without a name beside them."""
    hunt = select_causes(channel, rng, progress, sift=noise.reject_artefacts if noise else None)
    structure = None
    if channel.has_unnamed_structures:
        draws = hunt.ground.draw_null_residuals(N_NULL_DRAWS, rng)
        structure = find_structure(hunt.ground, draws, FAMILY_LEVEL)
    return _reject_artefacts(noise, hunt, structure) if noise else (hunt, structure)


def _doubt(claims: Claims, periods: Sequence[tuple[float, ...]], spoiled: str) -> Claims:
    """Return the claims without what a spoiled log or an open period forbids."""
    claims = claims.reject_all(spoiled) if spoiled else claims
    for k, fitting in enumerate(periods):
        claims = claims.judge(k, "several periods fit alike") if len(fitting) > 1 else claims
    return claims


def _tell(
    found: _Found, model: Model, case: FittedBaseline | None, rng: np.random.Generator
) -> tuple[list[Finding], tuple[Unexplained, ...]]:
    """Return what is said of every cause, of parameters off their nominal values, and of what has no name."""
    hunt, channel, after = found.hunt, found.hunt.channel, found.bars.fits[-1]
    findings = [
        leave_period_open(channel, one, finding, fitting) if len(fitting) > 1 else finding
        for one, finding, fitting in zip(
            hunt.found, build_findings(hunt, found.claims, found.bars, rng), found.periods, strict=True
        )
    ]
    unexplained = build_unexplained(hunt, found.tests.structure)
    if case:
        known = case.has_known_load  # it explains how the bodies differ from the model file
        changed = [] if known else find_parameter_changes(model, model.parameters, after.parameters, after.estimate)
        if found.spoiled:
            changed = [replace(f, status="suspected", why_not_confirmed=found.spoiled) for f in changed]
        findings = [*(add_band_note(finding, case.clear_hz) for finding in findings), *changed]
        sizes = measure_net_forces(hunt.library, found.claims.kept, after.parameters)
        least = np.maximum(MAX_LAW_ERROR * sizes.max(axis=0, initial=0.0), compute_least_forces(channel))
        unexplained = demote_small(unexplained, channel.outputs, after.errors.rms, least)
    if found.spoiled:
        unexplained = tuple(replace(u, status="suspected") for u in unexplained)
    return findings, unexplained


def _answer(
    found: _Found,
    findings: Sequence[Finding],
    unexplained: tuple[Unexplained, ...],
    model: Model,
    case: FittedBaseline | None,
    rng: np.random.Generator,
    *,
    seed: int,
    how: str,
    warnings: Sequence[str],
) -> Diagnosis:
    """Return the diagnosis: its verdict, what it rests on, and which model to use."""
    hunt, claims, bars, spoiled = found.hunt, found.claims, found.bars, found.spoiled
    channel, before, after = hunt.channel, bars.fits[0], bars.fits[-1]
    aliased = [finding for finding, fitting in zip(findings, found.periods, strict=False) if len(fitting) > 1]
    verdict = "cannot_tell" if spoiled else _judge(findings, unexplained, aliased)
    sentence = f"These data name no cause: {spoiled}."
    if not spoiled:
        errors = before.errors, after.errors
        sentence = describe_diagnosis(channel, verdict, findings, aliased, unexplained, errors)
    experiments = (f.experiment for f in aliased or findings if f.experiment and verdict == "cannot_tell")
    limits, untestable = compute_detection_limits(hunt, [f.cause for f in findings])
    use = Recommendation("neither", spoiled) if spoiled else recommend(hunt, claims, bars, rng, case and case.physics)
    floor = estimate_noise_floor(channel, after, np.random.default_rng(seed))
    settings = {"noise_draws": N_NULL_DRAWS, "family_level": FAMILY_LEVEL, "causes_tried": len(hunt.last)}
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=before.errors,
        extended=after.errors,
        noise_floor=floor,
        waterfall=(*bars.steps, Step("noise_floor", floor)),
        findings=tuple(sorted(findings, key=lambda f: f.rank)),
        unexplained=unexplained,
        limits=tuple(dict.fromkeys(limits)),
        untestable=tuple(dict.fromkeys(_with_drift(untestable, unexplained))),
        model=_extend(model, before, ()),
        extended_model=_build_extended_model(model, claims, bars, findings),
        traces=_build_traces(channel, before, after),
        n_parts=_measure_parts(channel),
        how=how,
        warnings=tuple(dict.fromkeys((*warnings, *use.warnings))),
        seed=seed,
        experiment=_MEND if spoiled else next(experiments, ""),
        recommendation=use.choice,
        recommendation_why=use.why,
        preparation=case and case.preparation,
        settings=({"preparation": case.preparation.to_dict()} if case else {}) | settings,
    )


def _describe_spoiled(warnings: Sequence[str]) -> str:
    """Return why nothing may be confirmed from logs that are not what they claim to be; empty where they are."""
    codes = dict.fromkeys(get_code(warning) for warning in warnings if is_diagnosis_invalid([warning]))
    return f"the log is not what it claims to be ({', '.join(codes)}); mend it first" if codes else ""


def _reject_artefacts(
    noise: NoiseOnlyBootstrap, hunt: StepwiseSelection, structure: Structure | None
) -> tuple[StepwiseSelection, Structure | None]:
    """Leave out what encoder noise alone could have made, beside all that was found."""
    kept = []
    for one in hunt.found:
        left = noise.reject_artefacts(hunt.ground, one.candidate, hunt.others(one), len(hunt.last))
        if left is not None:
            kept.append(replace(one, candidate=left))
    if structure is not None:
        chance = compute_structure_p_value(noise, hunt.ground, structure, build_effects(hunt.found))
        structure = structure if chance <= FAMILY_LEVEL else None
    return replace(hunt, found=tuple(kept)), structure


def _with_drift(untestable: Sequence[Untestable], unexplained: Sequence[Unexplained]) -> list[Untestable]:
    """Say that a residual that drifts in time may be warmth, where no temperature was logged."""
    drifts = [u.joint for u in unexplained if "t" in u.depends_on]
    if not drifts:
        return [*untestable]
    why = f"the residual of {drifts[0]} drifts in time, and the logs give no temperature"
    experiment = "log temp_JOINT or temp_room [degC] and repeat the motion from cold to warm"
    return [replace(u, why=why, experiment=experiment) if u.cause == "thermal_drift" else u for u in untestable]


def _judge(findings: Sequence[Finding], unexplained: Sequence[Unexplained], aliased: Sequence[Finding]) -> Verdict:
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if aliased or any("drive_gain" in f.indistinguishable_from for f in parameters):
        return "cannot_tell"
    if parameters:
        return "named"
    return "unexplained" if any(u.status == "confirmed" for u in unexplained) else "nothing_found"


def _build_extended_model(model: Model, claims: Claims, bars: Waterfall, findings: Sequence[Finding]) -> Model:
    """Return the model with the causes that stand; findings' standard errors count the settings' uncertainty, and are taken."""
    effects = [effect for effect in build_effects(claims.kept) if effect.name in EFFECTS]
    extended = _extend(model, bars.fits[-1], effects)
    own = {p.name: p.stderr for f in findings if f.status == "confirmed" for p in f.parameters}
    return extended.with_parameters(
        Parameters(replace(p, stderr=own[p.name]) if own.get(p.name) else p for p in extended.parameters)
    )


def _extend(model: Model, fit: EvaluatedFit, effects: Sequence[Effect]) -> Model:
    """Return a model with further effects and all values that the fit has; what belongs to the recording stays out."""
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    values = fit.parameters
    return extended.with_parameters(
        Parameters([values[p.name] if p.name in values else p for p in extended.parameters])
    )


def _build_traces(channel: Channel, before: EvaluatedFit, after: EvaluatedFit) -> tuple[TimeTrace, ...]:
    """Return what the time view draws."""
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def _measure_parts(channel: Channel) -> tuple[float, float, float]:
    """Return how long each part is [s]."""
    steps = [float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0 for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == which)) for dt, part in zip(steps, channel.parts, strict=True)) for which in EVERY
    )
    return one, two, three
