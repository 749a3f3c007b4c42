"""An identification: headline, verdict, error by joint, forces, friction, parameters, quality of fit."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from tau_dyn import results as r
from tau_dyn.evidence import MAX_MISSED_SHARE, MIN_STRUCTURED_SHARE, find_poor_fits
from tau_dyn.identify import ForceErrors, Identification
from tau_dyn.render.kinds import fit_quality
from tau_dyn.render.kinds.parameter_rows import (
    ParameterRow,
    build_parameter_rows,
    build_parameter_table,
    compute_bar_scale,
)
from tau_dyn.render.presentation import BADGES, ZOOM, flatten_rows, list_logs_used, present_kind, warn

_MAX_COMBINATIONS = 4
"""Largest number of combinations of parameters on the screen."""
_MAX_CURVES = 4
"""Largest number of friction curves in a notebook."""
POOR_PERCENT = 100 * MAX_MISSED_SHARE
"""Held-out error above which a model is reported as not usable, and a joint's fit as poor [%]."""
_HOPELESS_PERCENT = 50.0
"""Held-out error [%] that a missing cause cannot explain, but a column with a wrong sign or unit can."""
_LOOK = " Check signs, units and the order of columns first: tau-dyn check LOG ROBOT."
OVERFIT = 1.5
"""Ratio of held-out to training error above which the fit does not generalise to other data."""


@present_kind.register
def present_identification(found: Identification, *, truth: Mapping[str, float] | None = None) -> r.Presentation:
    """Return the presentation of an identification.

    Args:
        found: The result.
        truth: True parameter values by name, if the logs were simulated; adds a column.
    """
    robot, rows = found.model.robot, build_parameter_rows(found, truth)
    fits = [effect.equation for effect in found.model.effects]
    sections = [
        r.Chapter("errors", "", lambda: _build_glance(found, rows), r.On.PRINTED),
        *warn(found.warnings),
        r.Chapter("force", "Measured and predicted force", lambda: _build_forces(found)),
        *_list_friction(found, list(dict.fromkeys(fits))),
        r.Chapter("parameters", "Parameters", lambda: _build_parameters(found, rows, truth), r.On.ALL),
        *_list_per_log(found),
        *_list_motors(found),
        *_list_preloads(found),
        r.Chapter("uncertain", "", lambda: _list_uncertain(found), r.On.TERMINAL),
        r.Chapter("trust", "Quality of fit", lambda: _build_quality(found)),
    ]
    facts = [("friction model", found.friction or "as in the model file"), ("seed", str(found.seed))]
    return r.Presentation(
        "Identified dynamics", robot.name, f"{robot.name}: identified dynamics", describe_headline(found, truth),
        describe_verdict(found, truth), f"{fit_quality.describe_inputs(found)}.", sections, found.warnings, r.RobotPicture(robot),
        r.Provenance(facts, list_logs_used(found.model.provenance), robot), lambda: flatten_rows(found.rows()), found,
    )  # fmt: skip


def _build_glance(found: Identification, rows: Sequence[ParameterRow]) -> Iterator[r.Element]:
    judged = found.holdout or found.train
    known = sum(row.state == "known" for row in rows)
    title = "Held-out error" if found.holdout else "Error of the fit, no held-out data"
    facts = [(title, r.format_percent(judged.relative_error_percent), "")]
    if judged.all_samples is not None:
        facts.append(("Error over all samples", r.format_percent(judged.all_samples.relative_error_percent), ""))
    facts += [
        ("Parameters determined", str(known), f"of {len(rows)}"),
        ("Samples used", r.format_percent(100 * found.train.used_share), ""),
        ("Condition number", r.format_number(found.estimate.cond, 3), ""),
    ]
    left: list[r.Element] = [r.Text("Error by joint", "title"), _build_errors(found)]
    if found.holdout:
        left.append(
            r.explain(
                "Bar: held-out data. Tick: training data. Good: the bar ends at the tick. A bar far beyond the tick "
                "means poor generalisation."
            )
        )
    yield r.Beside(left, [r.Facts(facts)], "glance")
    if found.bands is not None:
        joints = found.bands.to_dict()["per_joint"].items()
        listed = [f"{j} {r.format_percent(100 * row['share'])}" for j, row in joints if row["share"] is not None]
        hold = r.format_percent(100 * found.bands.share)
        yield r.explain(f"Predictive bands at 90 % hold {hold} of the held-out samples ({r.format_list(listed, 6)}).")
    together = fit_quality.list_combinations(found)
    if together:
        more = len(together) - _MAX_COMBINATIONS
        listed = together[:_MAX_COMBINATIONS] + ([f"{more} more in --json and --report"] if more > 0 else [])
        said = f"Identifiable only in combination (value ± standard error): {'; '.join(listed)}."
        yield r.Text(said, on=r.On.TERMINAL)


def _build_errors(found: Identification) -> r.ResultTable:
    """Return one row per joint: held-out and training errors, errors of all samples, and the number of used samples."""
    judged, train, units = found.holdout or found.train, found.train, found.model.robot.force_units
    held, every = found.holdout is not None, judged.all_samples
    worst = max([*judged.per_joint_percent, *train.per_joint_percent], default=1.0) or 1.0
    columns = [
        r.Column("joint"),
        r.Column("residual as a share of the force", "bar", "wide", on=r.On.PAGE),
        r.Column("", "bar", on=r.On.TERMINAL),
        r.Column("held out" if held else "fit", "number", "strong"),
        r.Column("rms", "number"),
        *([r.Column("training", "number", "quiet")] if held else []),
        *([r.Column("all", "number"), r.Column("used", "number", "quiet")] if every is not None else []),
    ]
    rows = []
    for k, joint in enumerate(judged.joints):
        share = float(judged.per_joint_percent[k])
        bar = r.Bar(share / worst, tick=float(train.per_joint_percent[k]) / worst if held else None)
        rms = f"{r.format_number(float(judged.rms[k]), 3)} {r.format_unit(units[k])}"
        cells = [joint, bar, bar, *(("–", "–") if joint in judged.unjudged else (r.format_percent(share), rms))]
        trained = "–" if joint in train.unjudged else r.format_percent(float(train.per_joint_percent[k]))
        cells += [trained] if held else []
        if every is not None:
            used = judged.used_shares[k] if judged.used_shares else judged.used_share
            cells += [r.format_percent(float(every.per_joint_percent[k])), r.format_percent(100 * used)]
        rows.append(r.Row(cells))
    return r.ResultTable(columns, rows, on=r.On.PRINTED)


def _build_forces(found: Identification) -> Iterator[r.Element]:
    key = r.build_key(
        measured="measured", predicted="predicted", residual="residual", held="held out", masked="not used"
    )
    yield r.TimeView(
        "measured and predicted force over time, and the residual", list(fit_quality.list_views(found)), key
    )
    yield r.explain(
        f"{ZOOM}Both curves are low-pass filtered like the fit. Good: the lines coincide and the residual is a thin "
        "band without a pattern. Grey sections (reversals, ends of the log) are not used and may leave the scale. "
        "Bumps that repeat with position, speed or load are a model error."
        + (
            " The curve is of the final fit to the whole log; the held-out error comes from a fit to its first 70 % alone."
            if found.holdout and not found.model.provenance.get("held_out")
            else ""
        )
    )


def _list_friction(found: Identification, equations: Sequence[str]) -> list[r.Chapter]:
    curves = fit_quality.build_friction_curves(found)
    if not curves:
        return []
    offsets = [text for text in map(fit_quality.describe_offset, curves) if text]

    def build() -> Iterator[r.Element]:
        drawn = [fit_quality.build_friction_figure(curve) for curve in curves]
        means = "mean and standard deviation of the samples, by speed"
        key = r.build_key(cloud="samples", mean=means, predicted="identified law")
        yield r.Figures(drawn, key=key)
        yield r.Figures(drawn[:_MAX_CURVES], on=r.On.NOTEBOOK)
        subtracted = f" Subtracted: {'; '.join(offsets)}." if offsets else ""
        yield r.explain(
            f"Measured force minus the other identified forces{' and the offset' if offsets else ''}, corrected for "
            f"the low-pass filter at the step at zero speed. {'; '.join(equations)}. Good: the means lie on the line. "
            "A hook near zero speed is the Stribeck effect. A bend is drag. A wide or split cloud is friction that "
            f"depends on load, position or temperature.{subtracted}"
        )

    return [r.Chapter("friction", "Friction", build, r.On.DRAWN, "beside" if len(curves) == 1 else "")]


def _build_parameters(
    found: Identification, rows: Sequence[ParameterRow], truth: Mapping[str, float] | None
) -> Iterator[r.Element]:
    scale = r.format_percent(100 * compute_bar_scale(found.rows()))
    yield from build_parameter_table(rows, scale, truth=truth is not None, on=r.On.ALL)
    said = fit_quality.describe_truth_errors(list(rows))
    if said:
        yield r.Text(f"Comparison with the true values. {said}")
    fixed = fit_quality.describe_fixed(found)
    if fixed:
        yield r.explain(f"Fixed: {'; '.join(fixed)}.")


def _list_per_log(found: Identification) -> list[r.Chapter]:
    """Return the section of parameters with a value per log; an empty list without such parameters."""
    if not found.per_log:
        return []

    def build() -> Iterator[r.Element]:
        columns = [r.Column("parameter"), r.Column("log"), r.Column("value", "number"), r.Column("95 % interval", "number"),
                   r.Column("", "unit"), r.Column("", style="remark")]  # fmt: skip
        rows = []
        for one in found.per_log:
            chance = "cannot be compared" if one.p_value is None else r.format_p_value(one.p_value)
            said = f"logs {'differ' if one.differ else 'do not differ'} ({chance})"
            for k, (log, value, stderr) in enumerate(one.values):
                ends = one.values[k].to_dict()["ci95"]
                shown = r.format_number(value) if stderr is None else r.format_with_uncertainty(value, stderr)
                interval = "" if stderr is None else r.format_interval(ends, stderr)
                unit = r.format_unit(one.unit)
                rows.append(r.Row([one.name if k == 0 else "", log, shown, interval, unit, said if k == 0 else ""]))
        yield r.ResultTable(columns, rows, on=r.On.ALL)
        yield r.explain(
            "One estimate of all logs; everything else is shared. p is the chance of such differences between equal logs, "
            "over all these parameters together. The table above and the model hold the mean."
        )

    return [r.Chapter("per_log", "Values by log", build, r.On.ALL)]


def _list_motors(found: Identification) -> list[r.Chapter]:
    """Return the section of the motors' circuits; an empty list without a voltage in addition to current or force."""
    if not len(found.motors):
        return []

    def build() -> Iterator[r.Element]:
        columns = [r.Column("parameter"), r.Column("value", "number"), r.Column("", "unit")]
        rows = [
            r.Row([p.name, r.format_with_uncertainty(p.value, p.stderr or 0.0), r.format_unit(p.unit)])
            for p in found.motors
        ]
        yield r.ResultTable(columns, rows, on=r.On.ALL)
        yield r.explain(
            "The voltage gives u = R i + back-EMF v + L di/dt + offset, with the force in place of a current that is not logged. "
            "Behind an ideal gear the back-EMF is the joint's torque constant in N m/A."
        )

    return [r.Chapter("motors", "Motors", build, r.On.ALL)]


def _list_preloads(found: Identification) -> list[r.Chapter]:
    """Return the section of the force inside a robot with more drives than freedoms; an empty list for other robots."""
    inside = found.internal_force
    if inside is None:
        return []

    def build() -> Iterator[r.Element]:
        columns = [
            r.Column("preload"),
            r.Column("value", "number"),
            r.Column("deviation", "number"),
            r.Column("", "unit"),
        ]
        rows = []
        for p, deviation in zip(inside.preloads, inside.deviations, strict=True):
            value = "not separable from friction" if p.stderr is None else r.format_with_uncertainty(p.value, p.stderr)
            rows.append(r.Row([p.name, value, r.format_number(float(deviation), 3), r.format_unit(p.unit)]))
        yield r.ResultTable(columns, rows, on=r.On.ALL)
        yield r.explain(f"{inside.to_dict()['assumed']}. The deviation is that of single samples, noise included.")

    return [r.Chapter("preloads", "Force inside the mechanism", build, r.On.ALL)]


def _list_uncertain(found: Identification) -> Iterator[r.Element]:
    """Yield the terminal's text below the table."""
    rows = found.rows()
    weak = found.poorly_determined
    alone = [row for row in rows if row["stderr"] is None and not row.get("depends_on")]
    unseen, hidden = ([row["name"] for row in alone if row["identifiable"] is known] for known in (True, False))
    others = len(found.equivalent) - 1
    alike = [*found.equivalent[:1], *([f"likewise for {others} more"] if others > 0 else [])]
    for title, items in (
        ("Poorly determined (standard error above 30 %)", [r.format_list(weak)] if weak else []),
        ("Not excited, nominal value kept", [r.format_list(unseen)] if unseen else []),
        ("Not identifiable by any motion, nominal value kept", [r.format_list(hidden)] if hidden else []),
        ("Equivalent models", alike),
    ):
        if items:
            yield r.Text(f"{title}: {'; '.join(items)}.", on=r.On.TERMINAL)


def _build_quality(found: Identification) -> Iterator[r.Element]:
    used = [r.Text("Data used", "heading"), r.Text(fit_quality.describe_used_data(found)),
            r.Listing(fit_quality.describe_preparation(found))]  # fmt: skip
    separation: list[r.Element] = [
        r.Text("Conditioning", "heading"),
        r.Text(fit_quality.describe_conditioning(found.estimate.cond)),
    ]
    pairs = fit_quality.list_correlations(found)
    if pairs:
        table = r.ResultTable(
            [r.Column(kind="number"), r.Column(), r.Column()],
            [r.Row((c, a, b)) for a, b, c in pairs],
            style="whole-names",
        )
        title = f"{r.count(len(pairs), 'strong correlation')}; use only the combinations"
        separation.append(r.Folded(title, [table], len(pairs) <= 3))
    else:
        separation.append(r.Text("No two parameters are correlated by more than 0.9."))
    together = fit_quality.list_combinations(found)
    if together:
        said = "Only these sums are identifiable; the table lists nominal values of their members."
        separation += [r.Text("Identifiable combinations", "heading"), r.Text(said), r.Listing(together, style="code")]
    if found.equivalent:
        separation.append(r.Listing(found.equivalent, "Equivalent models"))
    yield r.Beside(used, separation)
    residuals = fit_quality.compute_residuals(found)
    if residuals:
        yield r.Text("Residuals", "heading")
        yield r.Text(fit_quality.describe_whiteness(residuals))
        correlations = [fit_quality.build_correlation_figure(row) for row in residuals]
        yield r.Figures(correlations)
        yield r.Figures([fit_quality.build_residual_histogram(row) for row in residuals])
        yield r.explain(
            "Autocorrelation of the residual (line) and of white noise through the same low-pass filter (dashes), with "
            "its 95 % bound. Good: the line follows the dashes, then stays near zero. Below: distribution of the "
            "residual and a normal distribution of the same width. Good: a bell. Two humps or long tails are friction "
            "or outliers that the model lacks."
        )
    assumed = found.model.robot.assumed
    if assumed:
        yield r.Folded("Assumed in the robot file", [r.Listing(list(assumed))])


def describe_headline(found: Identification, truth: Mapping[str, float] | None = None) -> str:
    """Return the headline; if the truth is known, with true errors in addition to estimated ones."""
    if found.holdout is not None:
        start = f"Held-out prediction error: {describe_both_errors(found.holdout)}"
    else:
        start = f"Error of the fit: {describe_both_errors(found.train)}; there are no held-out data"
    return "; ".join([start, *_clauses(found.rows(), truth or {})]) + "."


def describe_both_errors(errors: ForceErrors) -> str:
    """Return the error on the samples that a fit uses, and the error on all samples."""
    used = r.format_percent(errors.relative_error_percent)
    return (
        used
        if errors.all_samples is None
        else f"{used} ({r.format_percent(errors.all_samples.relative_error_percent)} of all samples)"
    )


def describe_verdict(found: Identification, truth: Mapping[str, float] | None = None) -> r.Verdict:
    """Return the verdict on the use of the result; estimates far from a known true value are listed."""
    judged = found.holdout or found.train
    error, weak = judged.relative_error_percent, found.poorly_determined
    if error > POOR_PERCENT:
        look = _LOOK if error > _HOPELESS_PERCENT else ""
        return _judge("poor", f"Do not use it: {r.format_percent(error)} of the force is unexplained.{look}")
    if found.changes:
        times = r.format_list([f"{one.log} at {one.time_s:.4g} s" for one in found.changes], 3)
        return _judge("care", f"Cut the log where it changes and fit its parts: {times}.")
    rough = {j: p for j, p in zip(judged.joints, judged.per_joint_percent, strict=True) if p > POOR_PERCENT}
    if rough:
        return _judge("care", _describe_rough_joints(found, rough))
    if judged.unjudged:
        return _judge("care", f"The error at {r.format_list(judged.unjudged, 3)} is unknown: no sample could be used.")
    if found.holdout is None:
        return _judge("care", "Evaluate it on another log before use: these are the errors of the fit itself.")
    if error > OVERFIT * found.train.relative_error_percent:
        own = r.format_percent(found.train.relative_error_percent)
        return _judge(
            "care",
            f"The held-out error is much larger than the training error ({own}); record a richer motion before use.",
        )
    off = _missed(found.rows(), truth or {})
    if off:
        return _judge(
            "care",
            f"Usable for force prediction; more than 3 standard errors off the true value: {r.format_list(off, 3)}.",
        )
    if weak:
        shown = sum(row["stderr"] is not None for row in found.rows())
        return _judge(
            "care",
            f"Usable for force prediction on similar motion; {len(weak)} of {r.count(shown, 'identified parameter')} "
            f"{'is' if len(weak) == 1 else 'are'} poorly determined.",
        )
    if found.warnings:
        return _judge("care", f"Usable for force prediction; read {r.count(len(found.warnings), 'warning')} first.")
    if not all(residual.white for residual in fit_quality.compute_residuals(found)):
        return _judge(
            "good", "Use it for feedforward and simulation; residuals are not white, so estimates may be biased."
        )
    return _judge("good", "Use it for feedforward and simulation; every identified parameter is determined.")


def _describe_rough_joints(found: Identification, rough: Mapping[str, float]) -> str:
    """Return a sentence on the joints with large errors [%]: those that a model misses, or else those with noise.

    The residual of the training logs tells noise; a joint whose held-out error is much larger is missed, too.
    """
    trained = dict(zip(found.train.joints, found.train.per_joint_percent, strict=True))
    fits = find_poor_fits(found.estimate.regression, found.estimate.residuals(), MIN_STRUCTURED_SHARE)
    poor = {fit.joint for fit in fits}
    missed = [joint for joint in rough if joint in poor or rough[joint] > OVERFIT * trained[joint]]
    listed = r.format_list([f"{joint} ({r.format_percent(rough[joint])})" for joint in missed or rough], 3)
    if missed:
        return f"Too much of the force is unexplained at {listed}."
    return f"The error at {listed} is noise of the measured force; a faster motion or a load there determines more."


_judge = partial(r.judge, badges=BADGES)


def name_mass_group(name: str) -> str:
    """Return the kind of body of a mass, without its number: `rod2a_link.mass` -> `rod`."""
    owner = name.rsplit(".", 1)[0].removesuffix("_link")
    return re.sub(r"_?\d+[a-z]?$", "", owner) or owner


def _missed(rows: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> list[str]:
    """Return the names of estimates that differ from the truth by more than three standard errors."""
    compared = [row for row in rows if row["name"] in truth and row["stderr"]]
    return [row["name"] for row in compared if abs(row["value"] - truth[row["name"]]) > 3 * row["stderr"]]


def _clauses(rows: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> list[str]:
    masses = [row for row in rows if row["name"].endswith(".mass")]
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in masses:
        groups.setdefault(name_mass_group(row["name"]), []).append(row)
    if len(groups) > 3 or not masses:
        known = sum(row["determined"] for row in rows)
        return [f"{known} of {r.count(len(rows), 'parameter')} have a standard error below 30 %"]
    clauses = [
        _known(name, members, truth) for name, members in groups.items() if any(row["determined"] for row in members)
    ]
    weak = [n for n, g in groups.items() if not any(row["determined"] for row in g) and any(row["stderr"] for row in g)]
    unseen = [n for n, g in groups.items() if all(row["stderr"] is None for row in g)]
    if weak:
        clauses.append(f"{_masses(weak, groups)} poorly determined")
    if unseen:
        apart = all(not row["identifiable"] for n in unseen for row in groups[n])
        clauses.append(f"{_masses(unseen, groups)} {'identifiable only in combination' if apart else 'not excited'}")
    return clauses


def _known(name: str, members: Sequence[dict[str, Any]], truth: Mapping[str, float]) -> str:
    known = [row for row in members if row["determined"]]
    some = f"{len(known)} of {len(members)} " if len(known) < len(members) else ""
    what = f"{some}{name} {'mass' if len(members) == 1 else 'masses'}"
    true = [truth.get(row["name"]) for row in known]
    if all(true):
        off = max(100 * abs(row["value"] / x - 1) for row, x in zip(known, true, strict=True) if x)
        if _missed(known, truth):
            return f"{what}: up to {r.format_percent(off)} from the true value, more than 3 standard errors"
        return f"{what}: within {r.format_percent(off)} of the true value"
    if len(members) == 1:
        row = known[0]
        low, high = (r.round_to_stderr(x, row["stderr"]) for x in row["ci95"])
        value = f"{what} {r.round_to_stderr(row['value'], row['stderr'])} {row['unit']}"
        return f"{value}, 95 % interval [{low}, {high}] {row['unit']}"
    return f"{what}: standard errors of {r.format_percent(max(100 * row['stderr'] / abs(row['value']) for row in known))} or less"


def _masses(names: Sequence[str], groups: dict[str, list[dict[str, Any]]]) -> str:
    several = len(names) > 1 or len(groups[names[0]]) > 1
    return f"{r.format_list(names)} {'masses are' if several else 'mass is'}"
