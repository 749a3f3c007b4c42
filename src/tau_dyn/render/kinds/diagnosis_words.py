"""A diagnosis in sentences and plots: the verdict, the evidence of a finding, detection limits, untestable causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.effects import NO_EXPERIMENT
from tau_dyn.evidence import (
    MAX_OUTPUT_LOSS_PERCENT,
    PRINTED_DIGITS,
    Diagnosis,
    Finding,
    Gain,
    Limit,
    OutputErrors,
    Signature,
    Status,
    Unexplained,
    Untestable,
)

BADGE: dict[str, tuple[r.Level, str]] = {
    "named": ("good", "Cause named"),
    "nothing_found": ("good", "No model error detected"),
    "cannot_tell": ("care", "Inconclusive"),
    "unexplained": ("care", "Unexplained"),
}
STATUS_LEVEL: dict[Status, r.Level] = {"confirmed": "good", "suspected": "care", "parameter": "care"}
MEASURED = {
    "force": "measured force",
    "tool": "measured tool position",
    "deflection": "measured deflection",
    "position": "range of motion",
}
FULL_EFFECT_SHARE = 0.8
"""Share of the predicted effect above which held-out data are reported to show the full effect."""
FINE = 90
"""Number of steps in which the fitted effect is drawn."""
JUMP = 4.0
"""Size of a step at zero, relative to the median step, above which the fitted curve is interrupted there."""


def describe_badge(diagnosis: Diagnosis) -> tuple[r.Level, str]:
    """Return the verdict's level and its short text; several causes are counted."""
    level, text = BADGE[diagnosis.verdict]
    n = sum(f.status == "confirmed" for f in diagnosis.findings)
    return (level, f"{r.count(n, 'cause')} named") if diagnosis.verdict == "named" and n > 1 else (level, text)


def recommend_model(diagnosis: Diagnosis) -> r.Verdict:
    """Return the recommendation in one sentence."""
    level, _ = BADGE[diagnosis.verdict]
    what, floor_ = describe_error_reference(diagnosis), r.format_percent(diagnosis.noise_floor.relative_error_percent)
    before, after = (r.format_percent(e.relative_error_percent) for e in (diagnosis.baseline, diagnosis.extended))
    if diagnosis.recommendation == "neither":
        return r.Verdict("poor", f"Use neither model: {diagnosis.recommendation_why}.")
    if diagnosis.recommendation == "extended":
        before, after = _print_fall(diagnosis.baseline, diagnosis.extended)
        band = diagnosis.search_band
        if band is not None and before == after:
            before, after = _print_fall(band.baseline, band.extended)
            what, floor_ = (
                f"{what} up to {band.cutoff_hz:.2g} Hz",
                r.format_percent(band.noise_floor.relative_error_percent),
            )
        if before == after:
            return r.Verdict(level, f"Use the extended model: {diagnosis.recommendation_why}.")
        text = f"Use the extended model: its error on held-out data is {after} of the {what} instead of {before}"
        text += _describe_largest_fall(diagnosis)
        limit = "" if diagnosis.channel == "position" else f" No output loses more than {MAX_OUTPUT_LOSS_PERCENT:g} %."
        return r.Verdict(level, f"{text}; noise floor: {floor_}.{limit}")
    if diagnosis.verdict == "named" and has_extension(diagnosis):
        return r.Verdict("care", f"Use the refitted model: {diagnosis.recommendation_why}.")
    if diagnosis.verdict == "cannot_tell":
        return r.Verdict(level, f"Experiment that would separate them: {r.end_sentence(diagnosis.experiment)}")
    if diagnosis.verdict == "unexplained":
        joints = r.format_list(dict.fromkeys(u.joint for u in diagnosis.unexplained))
        return r.Verdict(level, f"Significant unexplained structure at {joints}; see its plot.")
    text = f"Use the refitted model: its residual is {before} of the {what}; noise floor: {floor_}."
    if diagnosis.verdict == "named":
        return r.Verdict(level, text)
    return r.Verdict(level, f"{text} Detection limits are listed below.")


def _print_fall(before: OutputErrors, after: OutputErrors) -> tuple[str, str]:
    """Return two relative errors with enough digits to show a gain."""
    one, other = (r.format_percent(e.relative_error_percent, PRINTED_DIGITS) for e in (before, after))
    return one, other


_SMALL_FALL = 0.05
"""Relative fall of the error of all outputs below which the output that gains most is named."""


def _describe_largest_fall(diagnosis: Diagnosis) -> str:
    """Return the output whose error falls most where that of all outputs hardly falls."""
    before, after = diagnosis.baseline, diagnosis.extended
    if after.relative_error_percent < (1 - _SMALL_FALL) * before.relative_error_percent:
        return ""
    k = int(np.argmin(after.rms / np.maximum(before.rms, 1e-300)))
    one, other = (r.format_quantity(errors.rms[k], diagnosis.units[k]) for errors in (before, after))
    return f", most at {before.outputs[k]}, {other} instead of {one}" if one != other else ""


def has_extension(diagnosis: Diagnosis) -> bool:
    """Return whether a cause extends the model; else the extended model is the refitted one."""
    return any(f.status == "confirmed" for f in diagnosis.findings)


def describe_search_band(diagnosis: Diagnosis) -> str:
    """Return a sentence with the errors in the band of the search for causes; empty if all errors use this band."""
    band = diagnosis.search_band
    if band is None:
        return ""
    before, after, floor_ = (
        r.format_percent(e.relative_error_percent) for e in (band.baseline, band.extended, band.noise_floor)
    )
    more = f", of the extended model {after}" if has_extension(diagnosis) else ""
    return (
        f"These errors are of forces as identify filters them. Causes are searched up to {band.cutoff_hz:.2g} Hz; there "
        f"the residual of the refitted model is {before}{more}, the noise floor {floor_}."
    )


def describe_all_samples(diagnosis: Diagnosis) -> str:
    """Return a sentence with the errors over all samples and the share of used samples; empty if not known."""
    before, after = diagnosis.baseline.all_samples, diagnosis.extended.all_samples
    if before is None or after is None:
        return ""
    more = (
        f", of the extended model {r.format_percent(after.relative_error_percent)}" if has_extension(diagnosis) else ""
    )
    shares = diagnosis.baseline.used_shares
    each = r.format_list(
        [f"{o} {r.format_percent(100 * x)}" for o, x in zip(diagnosis.outputs, shares, strict=True)], 7
    )
    return (
        f"These errors are over the used samples ({each}). Over all samples, reversals and rests included, the "
        f"residual of the refitted model is {r.format_percent(before.relative_error_percent)}{more}."
    )


def describe_inputs(diagnosis: Diagnosis) -> str:
    """Return a summary of the inputs: logs, seconds, division into parts."""
    logs = list(dict.fromkeys(trace.log for trace in diagnosis.traces))
    named = f"{r.format_list(logs) if len(logs) <= 3 else r.count(len(logs), 'log')}; " if logs else ""
    return f"{named}{describe_parts(diagnosis)}."


def describe_parts(diagnosis: Diagnosis) -> str:
    """Return the duration of each part of the data."""
    train, confirm, judge = (f"{r.format_number(s, 3)} s" for s in diagnosis.n_parts)
    return f"training {train}, validation {confirm}, test {judge}"


def describe_error_reference(diagnosis: Diagnosis) -> str:
    """Return the reference of relative errors."""
    return MEASURED.get(diagnosis.channel, "measurement")


def format_title(finding: Finding) -> str:
    """Return a finding's heading, such as `Cyclic ripple · cart2`."""
    name = finding.cause.replace("_", " ")
    return f"{name[:1].upper()}{name[1:]}{' · ' if finding.joints else ''}{r.format_list(finding.joints)}"


def format_cause_name(cause: str) -> str:
    """Return a cause's name as words."""
    return cause.replace("_", " ")


def describe_gain(gain: Gain | None, unit: str = "") -> str:
    """Return the gain of a cause on test data, with its interval."""
    if gain is None:
        return "not applicable: the refit absorbs the effect, so the error does not change"
    word, sign = ("less", 1) if gain.reduction_percent >= 0 else ("more", -1)
    low, high = (r.format_number(x, 2) for x in sorted(sign * x for x in gain.ci95))
    before, after = r.format_quantity(gain.rms_before, unit), r.format_quantity(gain.rms_after, unit)
    change = f"{r.format_number(abs(gain.reduction_percent), 2)} % {word} residual"
    return f"{change}, 95 % interval [{low}, {high}] %; {before} → {after} rms"


def describe_confirmation(confirmation: tuple[float, float] | None) -> str:
    """Return the share of the predicted effect in the validation data."""
    if confirmation is None:
        return ""
    share, sigma = (100 * x for x in confirmation)
    text = f"validation: {share:.0f} ± {max(sigma, 1.0):.0f} % of the effect predicted from the training data"
    return f"{text}, weaker than predicted" if share + 2 * sigma < 100 * FULL_EFFECT_SHARE else text


def describe_unexplained(item: Unexplained) -> str:
    """Return a sentence about unexplained structure and the variable that it depends on."""
    share = r.format_percent(100 * item.share_of_residual_variance)
    text, on = f"{share} of the residual variance at {item.joint}", r.format_list(item.depends_on)
    if not item.depends_on:
        return f"{text} is above the noise floor and depends on no variable that was tested."
    if item.indistinguishable_from:
        on += f" (or equally on {'; or on '.join(r.format_list(others) for others in item.indistinguishable_from)})"
    if item.status == "suspected":
        return f"{text} may depend on {on}; the validation data did not confirm it."
    return f"{text} depends on {on}; no known cause explains it."


def list_limits(limits: Sequence[Limit]) -> list[str]:
    """Return the detection limit of each cause."""
    return [
        r.format_unit(limit.phrase)
        or f"{format_cause_name(limit.cause)} {r.format_quantity(limit.amplitude, limit.unit, 2)}"
        for limit in limits
    ]


def list_untestable(diagnosis: Diagnosis) -> list[Untestable]:
    """Return the causes that other logs would test; those whose part the robot lacks are left out."""
    return [item for item in diagnosis.untestable if item.experiment != NO_EXPERIMENT]


def group_by_reason(items: Sequence[Untestable]) -> list[tuple[str, list[str]]]:
    """Return each reason why causes could not be tested, with the names of these causes."""
    causes: dict[str, list[str]] = {}
    for item in items:
        causes.setdefault(item.why, []).append(format_cause_name(item.cause))
    return list(causes.items())


def list_settings(settings: Mapping[str, Any], owner: str = "") -> list[tuple[str, str]]:
    """Return settings as names and texts; the name of a nested setting follows that of its owner."""
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        name = f"{owner}{str(key).replace('_', ' ')}"
        if isinstance(value, Mapping):
            rows += list_settings(value, f"{name}: ")
        elif text := format_value(value):
            rows.append((name, text))
    return rows


def list_simulation_rows(simulation: Mapping[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return quantity, before and after, for each quantity compared in the closed-loop simulation."""
    before, after = ((simulation or {}).get(key) for key in ("before", "after"))
    if not isinstance(before, Mapping) or not isinstance(after, Mapping):
        return []
    texts = dict(list_settings(after))
    return [(name, text, texts.get(name, "")) for name, text in list_settings(before)]


def format_value(value: Any) -> str:
    """Return a setting's value as text."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value)
    if isinstance(value, float | np.floating):
        return r.format_number(float(value), 4) if isfinite(value) else "none"
    if isinstance(value, list | tuple | np.ndarray):
        return r.format_list([format_value(item) for item in value], 12)
    return "none" if value is None else str(value)


def build_signature_figures(signature: Signature, *, explained: bool = True) -> list[r.Figure]:
    """Return the plot without the cause and, if the cause is named, the plot of the residual with it, with equal axes.

    Args:
        signature: The signature to draw.
        explained: Whether `fitted` is a named cause; else it is only a smooth curve through unexplained structure.
    """
    after = signature.y - signature.fitted
    cloud = np.quantile(np.concatenate([signature.y, after]), [0.01, 0.99])
    _, means, _ = r.average_in_bins(signature.x, signature.y)
    ylim = r.pad_limits(cloud, means, np.quantile(signature.fitted, [0.005, 0.995]))
    x = r.Axis(r.format_unit(signature.x_label), r.pad_limits(signature.x, share=0.03))
    y = r.Axis(r.format_unit(signature.y_label), ylim)
    at, fitted = _trace_effect(signature)
    before, line = _scatter(signature.x, signature.y, ylim), r.Line(at, np.clip(fitted, *ylim))
    title = "without the cause" if explained else signature.output
    charts = [r.Figure(x, y, (before[0], line, before[1]), title)]
    return [*charts, r.Figure(x, y, _scatter(signature.x, after, ylim), "with it")] if explained else charts


def _scatter(x: np.ndarray, y: np.ndarray, limits: tuple[float, float]) -> tuple[r.Dots, r.Dots]:
    """Return the samples within limits, and their means."""
    inside = (y >= limits[0]) & (y <= limits[1])
    at, mean, _ = r.average_in_bins(x, y)
    return r.Dots(x[inside], y[inside], "cloud"), r.Dots(at, np.clip(mean, *limits))


def _trace_effect(signature: Signature) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted effect over the horizontal axis (n,) as means in fine steps, interrupted at zero if it jumps there."""
    at, mean, _ = r.average_in_bins(signature.x, signature.fitted, FINE)
    change = np.flatnonzero(np.diff(np.sign(at)))
    if change.size and len(at) > 4:
        steps, k = np.abs(np.diff(mean)), int(change[0])
        if steps[k] > JUMP * float(np.median(steps)):
            at, mean = np.insert(at, k + 1, 0.0), np.insert(mean, k + 1, np.nan)
    return at, mean
