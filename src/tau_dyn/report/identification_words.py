"""An identification in sentences: the headline, and how far the result may be used."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from tau_dyn.identify import ForceErrors, Identification
from tau_dyn.report.formatting import UseRecommendation, count, format_list, format_percent, round_to_stderr
from tau_dyn.report.residuals import compute_residuals

POOR_PERCENT = 20.0
"""Held-out error above which a model is called unfit: one fifth of the force is missed."""
_HOPELESS_PERCENT = 50.0
"""Held-out error that no missing cause explains, while a column with a turned sign or in another unit does."""
_LOOK = " Check signs, units and the order of columns first: tau-dyn check LOG ROBOT."
OVERFIT = 1.5
"""Held-out error over training error above which the fit does not carry over to other data."""


def describe_headline(found: Identification, truth: Mapping[str, float] | None = None) -> str:
    """Return the one sentence above everything; with the truth at hand it tells true errors, not only claimed ones."""
    if found.holdout is not None:
        start = f"Held-out prediction error: {describe_both_errors(found.holdout)}"
    else:
        start = f"Error of the fit: {describe_both_errors(found.train)}; there are no held-out data"
    return "; ".join([start, *_clauses(found.rows(), truth or {})]) + "."


def describe_both_errors(errors: ForceErrors) -> str:
    """Return the error on the samples that a fit uses, and that on all samples beside it."""
    used = format_percent(errors.relative_error_percent)
    return (
        used
        if errors.all_samples is None
        else f"{used} ({format_percent(errors.all_samples.relative_error_percent)} of all samples)"
    )


def describe_verdict(found: Identification, truth: Mapping[str, float] | None = None) -> UseRecommendation:
    """Return how far the result may be used; estimates far from a known true value are named."""
    judged = found.holdout or found.train
    error, weak = judged.relative_error_percent, [r for r in found.rows() if not r["determined"]]
    if error > POOR_PERCENT:
        look = _LOOK if error > _HOPELESS_PERCENT else ""
        return UseRecommendation("poor", f"Do not use it: {format_percent(error)} of the force is unexplained.{look}")
    rough = {j: p for j, p in zip(judged.joints, judged.per_joint_percent, strict=True) if p > POOR_PERCENT}
    if rough:
        missed = format_list([f"{joint} ({format_percent(p)})" for joint, p in rough.items()], 3)
        return UseRecommendation("care", f"Too much of the force is unexplained at {missed}.")
    if judged.unjudged:
        return UseRecommendation(
            "care", f"The error at {format_list(judged.unjudged, 3)} is unknown: no sample could be used."
        )
    if found.holdout is None:
        return UseRecommendation(
            "care", "Evaluate it on another log before use: these are the errors of the fit itself."
        )
    if error > OVERFIT * found.train.relative_error_percent:
        own = format_percent(found.train.relative_error_percent)
        return UseRecommendation(
            "care",
            f"The held-out error is much larger than the training error ({own}); record a richer motion before use.",
        )
    off = _missed(found.rows(), truth or {})
    if off:
        return UseRecommendation(
            "care",
            f"Usable for force prediction; more than 3 standard errors off the true value: {format_list(off, 3)}.",
        )
    if weak:
        return UseRecommendation(
            "care",
            f"Usable for force prediction on similar motion; {len(weak)} of {count(len(found.rows()), 'parameter')} "
            f"{'is' if len(weak) == 1 else 'are'} poorly determined.",
        )
    if found.warnings:
        return UseRecommendation(
            "care", f"Usable for force prediction; read {count(len(found.warnings), 'warning')} first."
        )
    if not all(residual.white for residual in compute_residuals(found)):
        return UseRecommendation(
            "good", "Use it for feedforward and simulation; residuals are not white, so estimates may be biased."
        )
    return UseRecommendation("good", "Use it for feedforward and simulation; every parameter is determined.")


def name_mass_group(name: str) -> str:
    """Return what a mass is a mass of, without its number: `rod2a_link.mass` -> `rod`."""
    owner = name.rsplit(".", 1)[0].removesuffix("_link")
    return re.sub(r"_?\d+[a-z]?$", "", owner) or owner


def _missed(rows: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> list[str]:
    """Return the names of estimates more than three standard errors away from the truth."""
    compared = [r for r in rows if r["name"] in truth and r["stderr"]]
    return [r["name"] for r in compared if abs(r["value"] - truth[r["name"]]) > 3 * r["stderr"]]


def _clauses(rows: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> list[str]:
    masses = [r for r in rows if r["name"].endswith(".mass")]
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in masses:
        groups.setdefault(name_mass_group(row["name"]), []).append(row)
    if len(groups) > 3 or not masses:
        known = sum(r["determined"] for r in rows)
        return [f"{known} of {count(len(rows), 'parameter')} have a standard error below 30 %"]
    clauses = [
        _known(name, members, truth) for name, members in groups.items() if any(r["determined"] for r in members)
    ]
    weak = [n for n, g in groups.items() if not any(r["determined"] for r in g) and any(r["stderr"] for r in g)]
    unseen = [n for n, g in groups.items() if all(r["stderr"] is None for r in g)]
    if weak:
        clauses.append(f"{_masses(weak, groups)} poorly determined")
    if unseen:
        apart = all(not r["identifiable"] for n in unseen for r in groups[n])
        clauses.append(f"{_masses(unseen, groups)} {'identifiable only in combination' if apart else 'not excited'}")
    return clauses


def _known(name: str, members: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> str:
    known = [r for r in members if r["determined"]]
    some = f"{len(known)} of {len(members)} " if len(known) < len(members) else ""
    what = f"{some}{name} {'mass' if len(members) == 1 else 'masses'}"
    true = [truth.get(r["name"]) for r in known]
    if all(true):
        off = max(100 * abs(r["value"] / x - 1) for r, x in zip(known, true, strict=True) if x)
        if _missed(known, truth):
            return f"{what}: up to {format_percent(off)} from the true value, more than 3 standard errors"
        return f"{what}: within {format_percent(off)} of the true value"
    if len(members) == 1:
        r = known[0]
        low, high = (round_to_stderr(x, r["stderr"]) for x in r["ci95"])
        return (
            f"{what} {round_to_stderr(r['value'], r['stderr'])} {r['unit']}, 95 % interval [{low}, {high}] {r['unit']}"
        )
    return (
        f"{what}: standard errors of {format_percent(max(100 * r['stderr'] / abs(r['value']) for r in known))} or less"
    )


def _masses(names: Sequence[str], groups: dict[str, list[dict[str, Any]]]) -> str:
    several = len(names) > 1 or len(groups[names[0]]) > 1
    return f"{format_list(names)} {'masses are' if several else 'mass is'}"
