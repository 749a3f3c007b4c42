"""A diagnosis: the model error, its causes, and the improvement by each cause.

The order is: the answer, the waterfall, one card for each finding, unexplained structure, forces over time, detection limits,
parameters, and quality of the fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn import results as r
from tau_dyn.evidence import Diagnosis, Finding, TimeTrace, Unexplained
from tau_dyn.render.kinds import diagnosis_words as words
from tau_dyn.render.kinds.parameter_rows import build_extended_rows, build_parameter_table
from tau_dyn.render.kinds.waterfall import (
    build_output_series,
    build_output_tables,
    build_total_series,
    build_total_table,
    format_finding,
)
from tau_dyn.render.presentation import ZOOM, list_logs_used, pad_used, present_kind, warn

PARTS = {1: "confirm", 2: "held"}
"""Shades of the parts of the data in the time view; training data are not shaded."""
_LIMIT = "detection limit (95 % power, worst joint)"
_MAX_PICTURED = 2
"""Findings whose signature a notebook shows."""


@present_kind.register
def present_diagnosis(found: Diagnosis) -> r.Presentation:
    """Return the presentation of a diagnosis."""
    robot, (level, badge) = found.model.robot, words.describe_badge(found)
    cards = [_build_card(found, finding, k) for k, finding in enumerate(found.findings)]
    sections = [
        r.Chapter(
            "waterfall", f"Residual as a share of the {words.describe_error_reference(found)}, by model",
            lambda: _build_waterfall(found), r.On.ALL,
        ),
        *warn(found.warnings),
        *cards,
        *(_build_open_end(item, k) for k, item in enumerate(found.unexplained)),
        r.Chapter("time", "Measured, before and after", lambda: _build_time(found), when=bool(found.traces)),
        r.Chapter("limits", f"Not detected; {_LIMIT}", lambda: _build_limits(found)),
        r.Chapter("parameters", "Parameters of the extended model", lambda: _build_parameters(found)),
        r.Chapter("trust", "Quality of fit", lambda: _build_quality(found)),
        r.Chapter("uncertain", "", lambda: _list_uncertain(found), r.On.TERMINAL),
    ]  # fmt: skip
    return r.Presentation(
        "Diagnosis", robot.name, f"{robot.name}: diagnosis", found.sentence,
        r.Verdict(level, words.recommend_model(found).sentence, badge), words.describe_inputs(found), sections, found.warnings,
        r.RobotPicture(robot, _list_joints(found)),
        r.Provenance([("seed", str(found.seed))], list_logs_used(found.model.provenance), robot), lambda: _tabulate(found), found,
        [f"{words.format_title(f)} ({f.status}): {r.replace_plus_minus(f.sentence)}" for f in found.findings],
    )  # fmt: skip


def _tabulate(found: Diagnosis) -> list[dict[str, object]]:
    """Return one row for each finding, strongest first; its gain is measured on test data."""
    rows = []
    for f in found.findings:
        low, high = (np.nan, np.nan) if f.gain is None else f.gain.ci95
        rows.append(
            {
                "cause": f.cause, "joints": ", ".join(f.joints), "status": f.status, "score": f.score, "p_value": f.p_value,
                "gain_percent": np.nan if f.gain is None else f.gain.reduction_percent, "gain_low": low, "gain_high": high,
                "equation": f.equation, "sentence": f.sentence,
            }
        )  # fmt: skip
    return rows


def _list_joints(found: Diagnosis) -> tuple[str, ...]:
    """Return the joints of confirmed causes, else those of suspected causes or unexplained structure."""
    confirmed = [f for f in found.findings if f.status == "confirmed"]
    named = [j for f in (confirmed or found.findings) for j in f.joints]
    return tuple(dict.fromkeys(named or [u.joint for u in found.unexplained]))


def _build_waterfall(found: Diagnosis) -> Iterator[r.Element]:
    whole, parts = build_total_series(found), build_output_series(found)
    reference = words.describe_error_reference(found)
    yield build_total_table(whole)
    cut = " The first bar is cut." if whole.rungs and whole.rungs[0].left > whole.end else ""
    click = " Click a cause for its evidence." if found.findings else ""
    yield r.explain(
        "Solid: residual on the test data. Hatched: reduction of the residual by this step. Bracket: 95 % interval, "
        f"from blocks of the data. Dashed line: noise floor.{cut} Good: the last step ends at the dashed line.{click}"
    )
    every = words.describe_all_samples(found)
    if every:
        yield r.Text(every, on=r.On.PRINTED)
    if band := words.describe_search_band(found):
        yield r.Text(band, on=r.On.PRINTED)
    if parts:
        what = "axis" if found.channel == "tool" else "joint"
        yield r.Text(f"Each {what}, in percent of its own {reference}", "heading")
        yield r.Group(build_output_tables(parts), "multiples")
    simulated = words.list_simulation_rows(found.simulation)
    if simulated:
        yield r.Text("Simulated with its controller, compared with the log", "heading")
        columns = [r.Column(), r.Column("before", "number"), r.Column("after", "number", "strong")]
        yield r.ResultTable(columns, [r.Row(row) for row in simulated], style="plain fitted")


def _build_card(found: Diagnosis, finding: Finding, k: int) -> r.Chapter:
    pictured = r.On.DRAWN if sum(f.signature is not None for f in found.findings[:k]) < _MAX_PICTURED else r.On.PAGE

    def build() -> Iterator[r.Element]:
        yield r.Text(r.end_sentence(r.replace_plus_minus(finding.sentence)), "lead")
        if finding.equation:
            yield r.Text(finding.equation, "law")
        charts = [] if finding.signature is None else words.build_signature_figures(finding.signature)
        evidence = list(_list_evidence(found, finding))
        if not charts:
            yield r.Group(evidence, "evidence solo")
            return
        yield r.Beside(evidence, [r.Figures(charts, "pair", on=pictured)], "evidence")
        yield _build_key("residual with all other causes in the model", "the fitted effect.",
                         "Good: without the cause the means follow the line; with it they lie on zero.")  # fmt: skip

    said = "differs from the robot file" if finding.status == "parameter" else finding.status
    badge = r.Verdict(words.STATUS_LEVEL[finding.status], "", said)
    title = words.format_title(finding)
    return r.Chapter(f"finding-{k + 1}", title, build, r.On.DRAWN, "card", badge, k + 1)


def _build_key(cloud: str, fitted: str, reading: str) -> r.Element:
    return r.Figures(
        [], "none", [r.Key("cloud", cloud), r.Key("mean", "its mean"), r.Key("predicted", fitted), r.Key("", reading)]
    )


def _list_evidence(found: Diagnosis, finding: Finding) -> Iterator[r.Element]:
    if finding.parameters:
        columns = [
            r.Column(),
            r.Column("estimate ± standard error (1 σ)", "number", "strong"),
            r.Column("95 % interval", "number"),
        ]
        rows = [r.Row([p.name, r.format_estimate(p), r.format_estimate_interval(p)]) for p in finding.parameters]
        yield r.ResultTable(columns, rows, style="plain")
    rows = [("Not confirmed", finding.why_not_confirmed)] if finding.why_not_confirmed else []
    rows.append(("Gain", words.describe_gain(finding.gain, _get_unit(found, finding))))
    if finding.confirmation:
        rows.append(("Validation", words.describe_confirmation(finding.confirmation).removeprefix("validation: ")))
    rows.append(("Significance", f"{r.format_p_value(finding.p_value)}, corrected for the number of tests"))
    alike = "no other known cause"
    if finding.indistinguishable_from:
        alike = r.format_list(map(words.format_cause_name, finding.indistinguishable_from))
        alike += f". To separate them: {r.end_sentence(finding.experiment)}" if finding.experiment else ""
    yield r.Definitions([*rows, ("Indistinguishable from", alike)])


def _get_unit(found: Diagnosis, finding: Finding) -> str:
    """Return the unit of a finding's residual; empty if its outputs have several units."""
    units = {u for o, u in zip(found.outputs, found.units, strict=True) if o in finding.joints}
    units = units or set(found.units)
    return units.pop() if len(units) == 1 else ""


def _build_open_end(item: Unexplained, k: int) -> r.Chapter:
    def build() -> Iterator[r.Element]:
        yield r.Text(words.describe_unexplained(item), "lead")
        rows = [
            ("Depends on", r.format_list(item.depends_on)),
            ("Share", f"{r.format_percent(100 * item.share_of_residual_variance)} of the residual's variance"),
            *([("Suggested formula", item.suggested_formula)] if item.suggested_formula else []),
            ("Significance", r.format_p_value(item.p_value)),
        ]
        charts = [] if item.signature is None else words.build_signature_figures(item.signature, explained=False)
        yield r.Beside([r.Definitions(rows)], [r.Figures(charts, "pair")] if charts else [], "evidence")
        if charts:
            yield _build_key("residual with all named causes in the model", "fitted formula.",
                             "Good: the means lie on zero everywhere.")  # fmt: skip

    badge = r.Verdict(words.STATUS_LEVEL[item.status], "", item.status)
    title = f"Unexplained · {item.joint}"
    return r.Chapter(f"unexplained-{k + 1}", title, build, r.On.PAGE, "card unexplained", badge)


def _build_time(found: Diagnosis) -> Iterator[r.Element]:
    key = r.build_key(
        measured="measured",
        residual="before (refitted)",
        predicted="after (extended)",
        confirm="validation",
        held="test",
        masked="not used",
    )
    shares = np.sum([_sum_squares(trace) for trace in found.traces], axis=0)
    worst_first = np.argsort(-shares[0] / np.maximum(shares[1], 1e-300), kind="stable")
    views = [_build_view(found, trace, int(k)) for trace in found.traces for k in worst_first]
    yield r.TimeView("measured and predicted over time, before and after, and the residuals", views, key)
    yield r.explain(
        f"{ZOOM}All curves are filtered by the same low-pass. Good: blue covers grey, and the blue residual is a thin "
        "band without a pattern, in the shaded parts, too. Dark grey sections (reversals, ends of the log) are not "
        "used and may leave the scale."
    )


def _sum_squares(trace: TimeTrace) -> np.ndarray:
    """Return sums of squares (2, n) of the extended model's residual and of the measurement, over the used samples."""
    left = trace.measured - trace.after
    return np.array([np.sum(x**2 * trace.usable, axis=0) for x in (left, trace.measured)])


def _build_view(found: Diagnosis, trace: TimeTrace, k: int) -> r.View:
    """Return one output's measurement, both models and their residuals, in a readable unit."""
    used = trace.usable[:, k]
    three = np.column_stack([trace.measured[:, k], trace.before[:, k], trace.after[:, k]])
    factor, unit = r.choose_unit(found.units[k], float(np.max(np.abs(three[used]), initial=0.0)))
    measured, before, after = factor * three.T
    curves = (
        r.Curve("measured", "measured", measured),
        r.Curve("before", "residual", before),
        r.Curve("after", "predicted", after),
    )
    limits = pad_used(np.concatenate([x[used] for x in (measured, before, after)]))
    above = r.Strip(f"{found.channel} [{unit}]", curves, limits, 270)
    left = np.concatenate([(measured - before)[used], (measured - after)[used]])
    rest = r.Curve("before", "residual", measured - before), r.Curve("after", "predicted", measured - after)
    below = r.Strip(f"residual [{unit}]", rest, pad_used(np.concatenate([left, -left]), 0.1), 200, masked=True)
    seen = set(np.unique(trace.part).tolist())
    return r.View(trace.log, found.outputs[k], trace.t, (above, below), seen <= set(PARTS), _list_bands(trace), used)


def _list_bands(trace: TimeTrace) -> tuple[tuple[float, float, str], ...]:
    """Return the intervals of validation data and of test data."""
    edges = np.flatnonzero(np.diff(trace.part)) + 1
    starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [len(trace.t) - 1]])
    kinds = [PARTS.get(int(trace.part[start])) for start in starts]
    stretches = zip(trace.t[starts], trace.t[stops], kinds, strict=True)
    return tuple((float(start), float(stop), ink) for start, stop, ink in stretches if ink)


def _build_limits(found: Diagnosis) -> Iterator[r.Element]:
    if found.limits:
        yield r.Listing(words.list_limits(found.limits), style="limits")
        yield r.explain(
            "The smallest effect that these logs would have shown in 95 of 100 cases, at the joint where it shows least. An "
            "effect below its limit may exist."
        )
    else:
        yield r.Text("No detection limits were computed.")
    if untestable := words.list_untestable(found):
        yield r.Text("Not testable with these logs", "heading")
        rows = [r.Row([words.format_cause_name(u.cause), u.why, u.experiment]) for u in untestable]
        yield r.ResultTable([r.Column("cause"), r.Column("why"), r.Column("experiment")], rows, style="plain")


def _build_parameters(found: Diagnosis) -> list[r.Element]:
    rows, scale = build_extended_rows(found.extended_model, found.model.parameters)
    return build_parameter_table(rows, r.format_percent(100 * scale), before=True)


def _build_quality(found: Diagnosis) -> Iterator[r.Element]:
    whole, names = sum(found.n_parts) or 1.0, ("training", "validation", "test")
    parts = [
        (ink, f"{name} {r.format_number(s, 3)} s", s / whole)
        for ink, name, s in zip(("train", "confirm", "held"), names, found.n_parts, strict=True)
    ]
    said = (
        f"{r.end_sentence(found.how)} The search uses the training data alone. The validation data confirm each cause. "
        "The test data measure its gain."
    )
    data: list[r.Element] = [r.Text("Training, validation and test data", "heading"), r.Division(parts), r.Text(said)]
    settings = [r.Row(row) for row in words.list_settings(found.settings)]
    right: list[r.Element] = (
        [r.Text("Settings", "heading"), r.ResultTable([r.Column(), r.Column()], settings, style="plain")]
        if settings
        else []
    )
    yield r.Beside(data, right)
    assumed = found.model.robot.assumed
    if assumed:
        yield r.Folded("Assumed in the robot file", [r.Listing(list(assumed))])


def _list_uncertain(found: Diagnosis) -> Iterator[r.Element]:
    """Yield the terminal's text below the bars."""
    twins = [
        f"{words.format_title(f)} from {r.format_list(map(words.format_cause_name, f.indistinguishable_from))}"
        + (f"; to separate them: {f.experiment.rstrip('.')}" if f.experiment else "")
        for f in found.findings
        if f.indistinguishable_from
    ]
    limits = words.list_limits(found.limits)
    reasons = words.group_by_reason(words.list_untestable(found))
    for title, items in (
        ("Confirmed", [_describe_finding(f) for f in found.findings if f.status == "confirmed"]),
        ("Suspected, not confirmed", [_describe_finding(f) for f in found.findings if f.status == "suspected"]),
        ("Differs from the robot file", [_describe_finding(f) for f in found.findings if f.status == "parameter"]),
        ("Unexplained", [words.describe_unexplained(u) for u in found.unexplained]),
        ("These data cannot separate", twins),
        (f"Not detected; {_LIMIT}", [f"{', '.join(limits)}."] if limits else []),
        ("Not testable", [f"{r.format_list(causes, 9)}: {why}" for why, causes in reasons]),
    ):
        if items:
            yield r.Listing(items, title, on=r.On.TERMINAL)


def _describe_finding(finding: Finding) -> str:
    """Return a cause, its figures, and the reason if it is not confirmed."""
    figures = format_finding(finding)[1 if finding.joints else 0 :]  # the title names the joints
    text = f"{words.format_title(finding)}: {', '.join(figures)}"
    return f"{text}. Not confirmed: {finding.why_not_confirmed}" if finding.why_not_confirmed else text
