"""Diagnoses of several kinds of measurement of one robot as one: forces lead, tool positions and deflections add to them.

Baseline, waterfall and time view stay those of the first channel; a finding says which channel it comes from. What one
channel cannot test another may.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tau_dyn.diagnose.result import Diagnosis, Verdict
from tau_dyn.effects import Effect, JointwiseEffect
from tau_dyn.parameters import Parameters

_CHOICES = ("neither", "extended", "refitted")
"""What one channel says of the model counts for all, in this order."""


def merge_diagnoses(found: Sequence[Diagnosis]) -> Diagnosis:
    """Return several channels' diagnoses as one, the first leading."""
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
        verdict=_verdict(found),
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


def _verdict(found: Sequence[Diagnosis]) -> Verdict:
    order: tuple[Verdict, ...] = ("named", "cannot_tell", "unexplained", "nothing_found")
    said = {one.verdict for one in found}
    return next(verdict for verdict in order if verdict in said)


def _extended(first: Diagnosis, others: Sequence[Diagnosis]):
    """Return the first channel's extended model with the effects that the others add."""
    model = first.extended_model
    for one in others:
        known = {name for e in model.effects for name in e.parameters.names}
        parts = (_only_unknown(e, known) for e in one.extended_model.effects)
        new = [e for e in parts if e is not None]
        names = [n for e in new for n in e.parameters.names]
        values = one.extended_model.effect_parameters.select(names)
        model = replace(
            model,
            effects=(*model.effects, *new),
            effect_parameters=model.effect_parameters + Parameters(list(values)),
        )
    return model


def _only_unknown(effect: Effect, known: set[str]) -> Effect | None:
    """Return an effect on those of its joints that it does not have in the model yet; the first channel's values stay."""
    if not known & set(effect.parameters.names):
        return effect
    joints = [
        j for j in effect.joints if not any(name.startswith(f"{j}.") for name in known & set(effect.parameters.names))
    ]
    if not joints or not isinstance(effect, JointwiseEffect):
        return None
    left = type(effect)(joints, [effect.units[j] for j in joints], label=effect.label, **effect.settings)
    return None if known & set(left.parameters.names) else left
