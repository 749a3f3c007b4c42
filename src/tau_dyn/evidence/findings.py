"""Findings from causes that the data show: parameters with errors, a plot, a sentence, indistinguishable causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from tau_dyn.effects import EFFECTS, VOLTAGE, Effect, format_quantity, spell_unit
from tau_dyn.estimate import scale_columns
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.claims import Claims, Waterfall
from tau_dyn.evidence.confirmation import Confirmation
from tau_dyn.evidence.extended_fit import EvaluatedFit, fit_extended_model
from tau_dyn.evidence.measurements import EVERY, TRAIN, VALIDATION
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, NullModel
from tau_dyn.evidence.result import Finding, Gain, OutputErrors, SearchBand, Signature, Unexplained, Verdict
from tau_dyn.evidence.settings import differentiate_settings
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection, build_effects
from tau_dyn.parameters import Parameter, Parameters

_MAX_LISTED = 3  # causes that a sentence names
_POINTS = 2000  # points of a plot; more are not visible
MAX_CHANGE_STDERR = 2.0
"""Standard errors by which amplitudes may change with a rejected cause in the model: half the width of their 95 % intervals. A
larger change is uncertainty of the amplitude."""
_DEPENDENT = 1e-8
"""Part of the largest eigenvalue below which columns count as dependent."""
_BLIND = 0.01
"""Largest share of an amplitude in directions that dependent columns do not determine."""
_WITHIN = (
    " The held-out logs hardly excite it; held-out blocks of the training logs confirmed it and measured its gain."
)
_CHANGES = " Standard errors contain the change with a rejected cause in the model."
_TWIN_EXPERIMENT = "record {reveals}; that separates it from {twins}"
_EQUIVALENT = "no log of this kind separates it from {twins}; the force is the same"


def build_findings(
    selection: StepwiseSelection,
    claims: Claims,
    waterfall: Waterfall,
    rng: np.random.Generator,
    changes: Mapping[str, float] = MappingProxyType({}),
) -> list[Finding]:
    """Return the finding of every cause, confirmed or not, with all other causes in the model.

    Args:
        selection: The selection.
        claims: The causes with the reasons why some are not confirmed.
        waterfall: The waterfall with the gains.
        rng: Random numbers for the fits.
        changes: Changes of amplitudes with rejected causes in the model, by name; standard errors contain them.
    """
    selection = replace(selection, found=claims.found)
    found = []
    for one, test, why_not in zip(claims.found, claims.tests, claims.why_not, strict=True):
        if why_not:
            found.append(build_rejected_finding(selection, claims, one, why_not, test, rng))
        else:
            gain = waterfall.gains[claims.kept.index(one)]
            found.append(_build_finding(selection, one, test, waterfall.fits[-1], gain, changes=changes))
    return found


def build_rejected_finding(
    selection: StepwiseSelection,
    claims: Claims,
    one: SelectedCause,
    why_not: str,
    test: Confirmation,
    rng: np.random.Generator,
) -> Finding:
    """Return a suspected finding, whose parameters are from a fit of the confirmed causes and this one."""
    fit = fit_extended_model(selection.channel, [*build_effects(claims.kept), *one.candidate.effects], None, rng)
    return _build_finding(selection, one, test, fit, None, why_not)


def _build_finding(
    selection: StepwiseSelection,
    one: SelectedCause,
    test: Confirmation,
    fit: EvaluatedFit,
    gain: Gain | None,
    why_not: str = "",
    changes: Mapping[str, float] = MappingProxyType({}),
) -> Finding:
    """Return the finding of one cause, confirmed or not."""
    channel = selection.channel
    names = {n for e in one.candidate.effects for n in e.parameters.names}
    values = Parameters([p for p in fit.parameters if p.name in names])
    place = channel.scene.joints.index
    effects = tuple(sorted(one.candidate.effects, key=lambda effect: [place(j) for j in effect.joints]))
    null_model = NullModel.of(selection.library, (TRAIN, VALIDATION), selection.null_model.noise, selection.others(one))
    inflation = max(group.overdispersion for group in one.candidate.fits)
    alone = estimate_uncertainty(null_model, effects, values, inflation)
    parameters = _widen(alone, changes)
    changed = any(p.stderr and changes.get(p.name, 0.0) > MAX_CHANGE_STDERR * p.stderr for p in alone)
    first = effects[0]
    known = channel.scene.signals  # a law of a voltage is no alternative if no voltage is logged
    alike = [t for e in effects for t in e.equivalent if t not in EFFECTS or VOLTAGE not in {*EFFECTS[t].needs} - known]
    rivals = [twin for twin in one.rivals if twin not in alike]
    experiments = [
        text.format(reveals=first.reveals, twins=", ".join(twins).replace("_", " "))
        for text, twins in ((_TWIN_EXPERIMENT, rivals), (_EQUIVALENT, dict.fromkeys(alike)))
        if twins
    ]
    return Finding(
        cause=one.candidate.cause,
        joints=tuple(dict.fromkeys(j for effect in effects for j in effect.joints)),
        status="suspected" if why_not else first.confirmed_as,
        score=one.candidate.statistic,
        p_value=one.p_value,
        parameters=tuple(parameters),
        gain=gain,
        indistinguishable_from=tuple(dict.fromkeys([*alike, *one.rivals])),
        equation=first.equation,
        sentence=format_sentence(effects, parameters, gain)
        + (_WITHIN if test.within and not why_not else "")
        + (_CHANGES if changed else ""),
        experiment="; ".join(experiments),
        effects=effects,
        signature=build_signature(channel, one.candidate.effects, fit.residuals, values),
        channel=channel.name,
        confirmation=(test.share, test.stderr),
        why_not_confirmed=str(why_not),
        is_shown=test.is_confirmed,
    )


def estimate_uncertainty(
    null_model: NullModel, effects: Sequence[Effect], values: Parameters, inflation: float
) -> Parameters:
    """Return amplitudes and refined settings with standard errors that include each other's uncertainty.

    An amplitude that the baseline's refit absorbs has no standard error (a shared motor's inertia, which the links' inertia
    absorbs).
    """
    rows, columns = [], [null_model.rows(effect) for effect in effects]
    slopes = []
    for effect in effects:
        amplitude = values.select(effect.parameters.names).values
        slopes += [null_model.whiten_columns(x) for x in differentiate_settings(effect, amplitude, null_model.channel)]
    everything, norm = scale_columns(np.concatenate([*columns, *slopes], axis=1))
    variance = _variances(null_model.gram(everything)) / norm**2
    stderr = iter(None if np.isnan(x) else float(np.sqrt(inflation * x)) for x in variance)
    for effect in effects:
        for p in values.select(effect.parameters.names):
            rows.append(Parameter(p.name, p.value, p.unit, p.lower, p.upper, stderr=next(stderr), origin=effect.name))
    for effect in effects:
        owner, unit = "+".join(effect.joints), effect.units[effect.joints[0]]
        for key in effect.refined:
            name = f"{owner}.{key}{effect.label}"
            text = spell_unit(effect.setting_units.get(key, "1"), unit)
            rows.append(Parameter(name, effect.settings[key], text, stderr=next(stderr), origin=effect.name))
    return Parameters(rows)


def _widen(parameters: Parameters, changes: Mapping[str, float]) -> Parameters:
    """Return parameters whose standard errors contain a change of the model, uniform up to its size to both sides."""
    return Parameters(
        [
            replace(p, stderr=float(np.hypot(p.stderr, changes[p.name] / np.sqrt(3))))
            if p.stderr and p.name in changes
            else p
            for p in parameters
        ]
    )


def _variances(gram: np.ndarray) -> np.ndarray:
    """Return the variances (k,) of unit columns' amplitudes, the baseline refitted; nan where data do not determine them."""
    values, vectors = np.linalg.eigh(gram)
    seen = values > _DEPENDENT * max(values.max(initial=0.0), 1e-300)
    variance = (vectors[:, seen] ** 2 / values[seen]).sum(axis=1)
    blind = (vectors[:, ~seen] ** 2).sum(axis=1) > _BLIND
    return np.where(blind | (np.diag(gram) < MIN_UNABSORBED_SHARE), np.nan, variance)


def format_sentence(effects: Sequence[Effect], parameters: Parameters, gain: Gain | None) -> str:
    """Return the finding in a sentence."""
    text = "; ".join(f"{', '.join(effect.joints)}: {effect.describe(parameters)}" for effect in effects)
    if gain is not None:
        joints = list(dict.fromkeys(joint for effect in effects for joint in effect.joints))
        whose = f" of {joints[0]}" if len(joints) == 1 else " of these joints" if joints else ""
        text += f"; held-out error{whose} {format_reduction(gain.reduction_percent)}"
    return text + "."


def format_reduction(percent: float) -> str:
    """Return a gain in words; a weak cause may be significant at other frequencies than those that dominate the raw error."""
    return f"{percent:.{0 if percent >= 1 else 1}f} % smaller" if percent >= 0.05 else "not smaller"


def build_signature(
    channel: Channel, effects: Sequence[Effect], residuals: Sequence[np.ndarray], values: Parameters
) -> Signature | None:
    """Return the residual without these effects, of the output that shows them best, against the variable that it depends on."""
    made = [channel.columns(effect) for effect in effects]
    share = [
        np.sum([c[r] @ values.select(e.parameters.names).values for e, c in zip(effects, made, strict=True)], axis=0)
        for r in range(len(channel.runs))
    ]
    power = [float(np.sum(channel.gather(share, k, *EVERY) ** 2)) for k in range(len(channel.outputs))]
    k = int(np.argmax(power))
    label, x = build_axis(channel, effects[0], channel.outputs[k])
    xs = np.concatenate([v[m[:, k]] for v, m in zip(x, channel.masks(*EVERY), strict=True)])
    without = [e + s for e, s in zip(residuals, share, strict=True)]
    ys, fits = (channel.gather(values_of, k, *EVERY) for values_of in (without, share))
    if not len(xs):
        return None
    keep = np.unique(np.linspace(0, len(xs) - 1, min(_POINTS, len(xs))).astype(int))
    y_label = f"residual of {channel.outputs[k]} [{channel.units[k]}]"
    return Signature(channel.outputs[k], label, y_label, xs[keep], ys[keep], fits[keep])


def build_axis(channel: Channel, effect: Effect, output: str) -> tuple[str, list[np.ndarray]]:
    """Return the label of the horizontal axis of a cause's plot, and its values (n,) for each run."""
    variables = channel.variables()
    position = "m" if channel.scene.units[0] == "N" else "rad"
    joint = output if f"v_{output}" in variables[0] else effect.joints[0]
    if "period" in effect.settings:
        period = effect.settings["period"]
        return f"position of {joint}, modulo {1e3 * period:.4g} {'mm' if position == 'm' else 'mrad'} [{position}]", [
            np.mod(v[f"q_{joint}"], period) for v in variables
        ]
    if "temperature" in effect.needs:
        return f"temperature at {joint} [degC]", [v[f"temp_{joint}"] for v in variables]
    if effect.name in ("position_friction", "pinion_scale", "guideway_compliance", "cart_tilt"):
        return f"position of {joint} [{position}]", [v[f"q_{joint}"] for v in variables]
    if effect.name in ("delay", "joint_compliance", "transmission_error"):
        return f"acceleration of {joint} [{position}/s^2]", [v[f"a_{joint}"] for v in variables]
    return f"speed of {joint} [{position}/s]", [v[f"v_{joint}"] for v in variables]


def describe_diagnosis(
    channel: Channel,
    verdict: Verdict,
    findings: Sequence[Finding],
    aliased: Sequence[Finding],
    unexplained: Sequence[Unexplained],
    errors: tuple[OutputErrors, OutputErrors, SearchBand | None],
    loads: Sequence[Finding] = (),
) -> str:
    """Return the result in one or two sentences.

    Args:
        channel: The measurements.
        verdict: The verdict on everything but loads.
        findings: All findings except those of loads.
        aliased: Findings whose period is not identifiable.
        unexplained: Structure without a known cause.
        errors: Errors of the refitted and of the extended model, and in the band of the search if that is wider.
        loads: Findings of confirmed loads, which come first.
    """
    if channel.name == "force":
        rest = _describe_forces(verdict, findings, unexplained, *errors, other="other " if loads else "")
        return " ".join([*(f.sentence for f in loads), rest])
    named = [f for f in findings if f.status == "confirmed"]
    if channel.name == "tool":
        return _describe_tool(named, aliased, *errors[:2])
    return _describe_deflection(channel, named, unexplained, *errors[:2])


def _describe_forces(
    verdict: Verdict,
    findings: Sequence[Finding],
    unexplained: Sequence[Unexplained],
    before: OutputErrors,
    after: OutputErrors,
    band: SearchBand | None,
    other: str = "",
) -> str:
    """Return the result in one or two sentences."""
    missed = f"The residual of the refitted model is {before.relative_error_percent:.2g} % of the measured force"
    confirmed = [f for f in findings if f.status == "confirmed"]
    if confirmed:
        text = f"{missed}; with {_listed(confirmed)} it is {after.relative_error_percent:.2g} %."
        text += _describe_band(before, after, band)
        text += "".join(f" {f.sentence}" for f in findings if f.status == "parameter" and f.cause == "payload")
    elif verdict in ("named", "cannot_tell"):
        f = next(f for f in findings if f.status == "parameter")
        text = f"{missed}. {f.sentence}"
        if verdict == "cannot_tell":
            text += f" Indistinguishable with these data: {f.cause} and {', '.join(f.indistinguishable_from)}."
    elif verdict == "nothing_found":
        text = (
            f"{missed}. No {other}model error was detected: the residual is consistent with the noise at the 1 % level."
        )
    else:
        text = f"{missed}. No cause is confirmed, and the residual is not consistent with the noise."
        text += "".join(f" {_describe_rejection(f)}" for f in findings if f.contradicts_noise)
    if any(u.status == "confirmed" for u in unexplained):
        u = next(u for u in unexplained if u.status == "confirmed")
        what = ", ".join(u.depends_on)
        share = f"{100 * u.share_of_residual_variance:.0f} % of its residual"
        text += f" Significant unexplained structure at {u.joint} depends on {what} ({share})."
    return text


def _describe_band(before: OutputErrors, after: OutputErrors, band: SearchBand | None) -> str:
    """Return the errors in the band of the search if causes act above that of the reported errors; otherwise empty."""
    one, other = (f"{errors.relative_error_percent:.2g}" for errors in (before, after))
    if band is None or one != other:
        return ""
    high, low = (f"{errors.relative_error_percent:.2g}" for errors in (band.baseline, band.extended))
    return f" Of forces up to {band.cutoff_hz:.2g} Hz it is {high} % without and {low} % with the cause."


def _describe_rejection(finding: Finding) -> str:
    """Return a rejected cause that the validation data show, with the reason, as a sentence."""
    name, joints = finding.cause.replace("_", " "), ", ".join(finding.joints)
    return f"The data show {name} ({joints}), which is not confirmed: {finding.why_not_confirmed}."


def _listed(findings: Sequence[Finding]) -> str:
    """Return causes with their joints, at most three of them."""
    said = [f"{f.cause.replace('_', ' ')} ({', '.join(f.joints)})" for f in findings[:_MAX_LISTED]]
    if len(findings) > _MAX_LISTED:
        said.append(f"{len(findings) - _MAX_LISTED} more")
    return said[0] if len(said) == 1 else f"{', '.join(said[:-1])} and {said[-1]}"


def _describe_tool(
    named: Sequence[Finding], aliased: Sequence[Finding], before: OutputErrors, after: OutputErrors
) -> str:
    """Return the result in a sentence."""
    one, other = (format_quantity(float(np.linalg.norm(e.rms)), "m") for e in (before, after))
    text = f"The measured tool is {one} (rms) from forward kinematics"
    if named:
        causes = " and ".join(f"{f.cause} ({', '.join(f.joints)})" for f in named)
        return f"{text}; with {causes} it is {other}."
    if aliased:
        return f"{text}. {aliased[0].sentence} These positions do not show which."
    return f"{text}, and no cause that we know explains any of it."


def _describe_deflection(
    channel: Channel,
    named: Sequence[Finding],
    unexplained: Sequence[Unexplained],
    before: OutputErrors,
    after: OutputErrors,
) -> str:
    """Return the result in a sentence."""
    one, other = (
        ", ".join(
            f"{format_quantity(float(r), u)} at {o}" for r, u, o in zip(e.rms, channel.units, e.outputs, strict=True)
        )
        for e in (before, after)
    )
    text = f"The {channel.name} is {one} (rms)"
    if named:
        causes = " and ".join(f"{f.cause} ({', '.join(f.joints)})" for f in named)
        text += f"; with {causes}, {other} is left unexplained"
    else:
        text += ", and no cause that we know explains any of it"
    left = next((u for u in unexplained if u.status == "confirmed"), None)
    if left is not None:
        share = f"{100 * left.share_of_residual_variance:.0f} % of its residual"
        text += f". The residual at {left.joint} depends on {', '.join(left.depends_on)} and has no name ({share})"
    return f"{text}."
