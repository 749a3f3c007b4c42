"""One kind of measurement -> its diagnosis: causes searched, confirmed and measured, each on separate data.

    channel -> null model, candidate scan, stepwise selection -> confirmation -> claims with their gain -> diagnosis

Forces, tool positions and deflections take the same way. A force baseline stays physically consistent, its parameters are
compared with their nominal values, and a cause has to exceed the effect of encoder noise. A cyclic error of poses may have
several periods that fit equally well. A single joint's deflection and a tool have no mass that must stay positive and no
nominal value.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.deflection_channel import build_deflection_channel
from tau_dyn.diagnose.force_baseline import FittedBaseline, Progress
from tau_dyn.diagnose.loads import LoadReport, add_loads, find_loads, list_load_warnings
from tau_dyn.diagnose.nominal import describe_body_difference, find_parameter_changes
from tau_dyn.diagnose.preparation import compute_border_gap_s
from tau_dyn.diagnose.resonances import add_band_note, add_resonances
from tau_dyn.diagnose.tool_channel import build_tool_channel
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.estimate import Regression
from tau_dyn.evidence import (
    EVERY,
    FAMILY_LEVEL,
    MAX_LAW_ERROR,
    N_BOOTSTRAP_DRAWS,
    N_NULL_DRAWS,
    Channel,
    Claims,
    Diagnosis,
    EvaluatedFit,
    Examination,
    ExaminationOptions,
    Finding,
    LogChange,
    NoiseOnlyBootstrap,
    Recommendation,
    SearchBand,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
    Waterfall,
    build_effects,
    build_shared_columns,
    compute_detection_limits,
    compute_least_forces,
    decide_verdict,
    demote_small,
    describe_changes,
    describe_diagnosis,
    describe_poor_fits,
    describe_split,
    estimate_noise_floor,
    examine_channel,
    find_changes,
    find_poor_fits,
    fit_extended_model,
    list_changes,
    list_contradicting,
    measure_net_forces,
    recommend,
    search_channel,
)
from tau_dyn.exceptions import InputError
from tau_dyn.identify import drop_repeated_logs, is_diagnosis_invalid
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.results import capitalise
from tau_dyn.robot import Robot

_MEND = "mend the log or its column map as the first warning advises, or record it again"


def diagnose_forces(
    case: FittedBaseline, *, seed: int = 0, progress: Progress = lambda step: None, warnings: Sequence[str] = ()
) -> Diagnosis:
    """Find causes of the residual of a fitted baseline of forces, after changes within the logs."""
    channel, changes, how = case.channel, (), describe_split(any(case.held), "logs")
    if not case.nominal.robot.base_coordinates:  # contacts mix the rows of all joints, and force some of them to stop
        progress("changes within the logs")
        changes = find_case_changes(case)
        progress("looking for resonances")
        channel = add_resonances(channel)
    warnings = (*warnings, *case.warnings, *describe_changes(changes))
    doubt = _describe_spoiled(warnings) or _describe_broken(changes)
    found = diagnose_channel(
        channel, case.nominal, how, seed=seed, progress=progress, warnings=warnings, case=case, doubt=doubt
    )
    return replace(found, further=list_changes(changes))


def find_case_changes(case: FittedBaseline) -> tuple[LogChange, ...]:
    """Return the changes within the logs of a case."""
    channel = case.channel
    regression = Regression(channel.parameters, channel.outputs, channel.units, channel.runs, case.preparation)
    return find_changes(regression, build_shared_columns(regression, case.model.mechanism))


def _describe_broken(changes: Sequence[LogChange]) -> str:
    """Return why no cause may be confirmed if the force of a joint has another sign or scale in a part of a log; else empty."""
    broken = [one for one in changes if one.kind in ("sign", "gain")]
    if not broken:
        return ""
    one = broken[0]
    return f"the {one.kind} of the force of {one.joint} changes within {one.log} at {one.time_s:.4g} s; use the parts as two logs"


def diagnose_tool(
    model: Model,
    logs: Iterable[Log],
    *,
    holdout: Iterable[Log] = (),
    seed: int = 0,
    progress: Progress = lambda step: None,
    warnings: Sequence[str] = (),
) -> Diagnosis:
    """Find the causes of displacements of the tool; options and errors are those of `diagnose`.

    Args:
        model: Its robot's geometry gives forward kinematics, its masses the loads.
        logs: Logs with `q_J` and `x_tool y_tool z_tool`, sampled in time or static poses.
        holdout: Held-out logs.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: Earlier warnings.
    """
    train, held = list(logs), list(holdout)
    progress("columns")
    channel = add_resonances(build_tool_channel(model, train, held))
    how = describe_split(bool(held), "poses" if channel.poses else "logs")
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
    """Find the causes of the difference between the two encoders of a joint; options and errors are those of `diagnose`.

    Args:
        robot: The robot, for the names of its joints; its masses are not used.
        logs: Logs to train on, with `q_J`, `tau_J` and `q_link_J` of the same joints.
        holdout: Held-out logs.
        causes: Causes that may be found; by default all that act between two encoders.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: Earlier warnings.
    """
    given, judged = ([x] if isinstance(x, Log) else list(x) for x in (logs, holdout))
    train, held, doubled = drop_repeated_logs(given, judged)
    said = [*warnings, *doubled]
    if not train:
        raise InputError("missing_input", "no log was given")
    progress("columns")
    channel = build_deflection_channel(robot, train, held, causes)
    how = describe_split(bool(held), "logs")
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
    doubt: str = "",
) -> Diagnosis:
    """Find causes on a channel.

    Args:
        channel: The measurements.
        model: The model before any fit, which is extended by the causes found.
        how: How the data are divided, in words.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: Earlier warnings.
        case: The fitted baseline behind a channel of forces.
        doubt: The reason why no cause may be confirmed; empty if causes may be confirmed.
    """
    rng = np.random.default_rng(seed)
    options, loads, without, first = ExaminationOptions(rng, progress), [], None, None
    if case:
        options = _build_options(case, rng, progress, doubt)
        first = search_channel(channel, options)
        loads = find_loads(case, channel, build_effects(first[0].found), np.random.default_rng(seed))
        if not doubt and any(one.is_confirmed for one in loads):
            without = fit_extended_model(channel, (), case.physics, np.random.default_rng(seed)).reported.errors
            case = add_loads(case, loads)
            channel, first = case.carry_loads(channel, case.channel.prepared), None
            options = _build_options(case, rng, progress, doubt)
            warnings = (*warnings, *list_load_warnings(loads))
    found = examine_channel(channel, options, first)
    if case:
        found = _with_parameters(found, model, case, options.doubt)
        warnings = (*warnings, *_describe_poor_fits(found, case))
    report = LoadReport.of(loads, without)
    return _answer(found, options, model, case, report, seed=seed, how=how, warnings=warnings)


def _describe_poor_fits(found: Examination, case: FittedBaseline) -> Sequence[str]:
    """Return a warning about the outputs at which the error of the extended model is much larger than noise."""
    last = found.waterfall.fits[-1]
    regression = replace(last.regression, preparation=case.preparation)
    return describe_poor_fits(find_poor_fits(regression, last.residuals), causes_sought=True)


def _build_options(
    case: FittedBaseline, rng: np.random.Generator, progress: Progress, doubt: str
) -> ExaminationOptions:
    """Return the options of an examination of forces."""
    gap_s = compute_border_gap_s(case.preparation.force_cutoff_hz, case.channel.prepared[0].log.rate_hz)
    noise = NoiseOnlyBootstrap(lambda: [case.noise_only(rng) for _ in range(N_BOOTSTRAP_DRAWS)])
    return ExaminationOptions(rng, progress, noise, case.physics, case.pad_nominal(), gap_s, doubt)


def _with_parameters(found: Examination, model: Model, case: FittedBaseline, doubt: str) -> Examination:
    """Return the examination of forces with the parameters that differ from their nominal values.

    A load that is known from a model file alone explains the difference of the bodies.
    """
    channel, after = found.selection.channel, found.waterfall.fits[-1]
    changed: list[Finding] = []
    if not case.has_known_load:
        changed = find_parameter_changes(model, model.parameters, after.parameters, after.estimate)
    if doubt:
        changed = [replace(f, status="suspected", why_not_confirmed=doubt) for f in changed]
    findings = (*(add_band_note(finding, case.clear_hz) for finding in found.findings), *changed)
    sizes = measure_net_forces(found.selection.library, found.claims.kept, after.parameters)
    least = np.maximum(MAX_LAW_ERROR * sizes.max(axis=0, initial=0.0), compute_least_forces(channel))
    unexplained = demote_small(found.unexplained, channel.outputs, after.errors.rms, least)
    remark = ""
    if not (changed or case.has_known_load):
        remark = describe_body_difference(model, model.parameters, after.estimate)
    return replace(found, findings=findings, unexplained=unexplained, remark=remark)


def _answer(
    found: Examination,
    options: ExaminationOptions,
    model: Model,
    case: FittedBaseline | None,
    loads: LoadReport,
    *,
    seed: int,
    how: str,
    warnings: Sequence[str],
) -> Diagnosis:
    """Return the diagnosis: its verdict with the evidence, and the recommended model."""
    selection, claims, waterfall, spoiled, rng = (
        found.selection,
        found.claims,
        found.waterfall,
        options.doubt,
        options.rng,
    )
    findings, unexplained, aliased = found.findings, found.unexplained, found.aliased
    channel, before, after = selection.channel, waterfall.fits[0], waterfall.fits[-1]
    band = (
        None if case is None else _measure_search_band(channel, before, after, case.preparation.force_cutoff_hz, seed)
    )
    limits, untestable = compute_detection_limits(selection, [f.cause for f in findings])
    use = Recommendation("neither", spoiled)
    if not spoiled:
        overfit, physics = (case.overfit, case.physics) if case else (1.0, None)
        use = recommend(selection, claims, waterfall, rng, physics, has_load=bool(loads.confirmed), overfit=overfit)
    warnings = tuple(dict.fromkeys((*warnings, *use.warnings)))
    rest = "cannot_tell" if spoiled else decide_verdict(findings, unexplained, aliased, warnings)
    verdict = "named" if loads.confirmed and not spoiled else rest
    sentence = f"These data name no cause: {spoiled}."
    if not spoiled:
        errors = before.reported.errors, after.reported.errors, band
        sentence = describe_diagnosis(channel, rest, findings, aliased, unexplained, errors, loads.confirmed)
        reasons = list_contradicting(warnings) if rest == "unexplained" else []
        sentence = " ".join(filter(None, (sentence, found.remark, *(f"{capitalise(reason)}." for reason in reasons))))
    experiments = (f.experiment for f in aliased or findings if f.experiment and verdict == "cannot_tell")
    floor = estimate_noise_floor(channel.report(), after.reported, np.random.default_rng(seed))
    settings = {"noise_draws": N_NULL_DRAWS, "family_level": FAMILY_LEVEL, "causes_tried": len(selection.last)}
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=before.reported.errors,
        extended=after.reported.errors,
        noise_floor=floor,
        waterfall=loads.insert_step((*waterfall.steps, Step("noise_floor", floor))),
        findings=tuple(sorted((*findings, *loads.findings), key=lambda f: f.rank)),
        unexplained=unexplained,
        limits=tuple(dict.fromkeys(limits)),
        untestable=tuple(dict.fromkeys(_with_drift(untestable, unexplained))),
        model=_extend(model, before, ()),
        extended_model=_build_extended_model(model, claims, waterfall, findings),
        traces=_build_traces(channel, before, after),
        n_parts=_measure_parts(channel),
        how=how,
        warnings=warnings,
        seed=seed,
        experiment=_MEND if spoiled else next(experiments, ""),
        recommendation=use.choice,
        recommendation_why=use.why,
        preparation=case and case.preparation,
        settings=({"preparation": case.preparation.to_dict()} if case else {}) | settings,
        search_band=band,
    )


def _measure_search_band(
    channel: Channel, before: EvaluatedFit, after: EvaluatedFit, cutoff_hz: float, seed: int
) -> SearchBand | None:
    """Return the errors in the band in which causes are searched; None if errors are reported in the same one."""
    if channel.report() is channel:
        return None
    floor = estimate_noise_floor(channel, after, np.random.default_rng(seed))
    return SearchBand(cutoff_hz, before.errors, after.errors, floor)


def _describe_spoiled(warnings: Sequence[str]) -> str:
    """Return the reason why no cause may be confirmed from faulty logs; empty for sound ones."""
    codes = dict.fromkeys(get_code(warning) for warning in warnings if is_diagnosis_invalid([warning]))
    return f"the log contradicts the robot file or itself ({', '.join(codes)}); mend it first" if codes else ""


def _with_drift(untestable: Sequence[Untestable], unexplained: Sequence[Unexplained]) -> list[Untestable]:
    """Warn that a residual that drifts in time may be due to temperature, if no temperature was logged."""
    drifts = [u.joint for u in unexplained if "t" in u.depends_on]
    if not drifts:
        return [*untestable]
    why = f"the residual of {drifts[0]} drifts in time, and the logs give no temperature"
    experiment = "log temp_JOINT or temp_room [degC] and repeat the motion from cold to warm"
    return [replace(u, why=why, experiment=experiment) if u.cause == "thermal_drift" else u for u in untestable]


def _build_extended_model(model: Model, claims: Claims, waterfall: Waterfall, findings: Sequence[Finding]) -> Model:
    """Return the model with the accepted causes; standard errors are those of the findings, which include the settings'."""
    effects = [effect for effect in build_effects(claims.kept) if effect.name in EFFECTS]
    extended = _extend(model, waterfall.fits[-1], effects)
    own = {p.name: p.stderr for f in findings if f.status == "confirmed" for p in f.parameters}
    return extended.with_parameters(
        Parameters(replace(p, stderr=own[p.name]) if own.get(p.name) else p for p in extended.parameters)
    )


def _extend(model: Model, fit: EvaluatedFit, effects: Sequence[Effect]) -> Model:
    """Return a model with further effects and all values of the fit, without the parameters of the recording."""
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    values = fit.parameters
    return extended.with_parameters(
        Parameters([values[p.name] if p.name in values else p for p in extended.parameters])
    )


def _build_traces(channel: Channel, before: EvaluatedFit, after: EvaluatedFit) -> tuple[TimeTrace, ...]:
    """Return the curves of the time view."""
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def _measure_parts(channel: Channel) -> tuple[float, float, float]:
    """Return the length of each part [s]."""
    steps = [float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0 for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == which)) for dt, part in zip(steps, channel.parts, strict=True)) for which in EVERY
    )
    return one, two, three
