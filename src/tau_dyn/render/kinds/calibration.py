"""A calibration: error before and after, gain of each model, geometry, not identifiable parameters; and the plan of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.calibrate import (
    CHANGE,
    Calibration,
    CandidateModel,
    build_device_rows,
    build_frame_rows,
    build_parameter_rows,
    compute_sensitivities,
    list_correlated_pairs,
)
from tau_dyn.calibrate.poses import CalibrationCampaign
from tau_dyn.evidence import Finding
from tau_dyn.log import format_names
from tau_dyn.render.kinds import calibration_words as words
from tau_dyn.render.kinds.calibration_words import format_angle, format_length
from tau_dyn.render.kinds.waterfall import WaterfallSeries, WaterfallStep
from tau_dyn.render.presentation import flatten_rows, present_kind, warn

_MAX_NAMES = 6  # parameters that are listed as equivalent to another
_MAX_CORRELATED = 12  # pairs listed at most
_MAX_SENSITIVE = 12  # parameters listed at most
_MAX_PLANS = 8  # rows of a plan's curve at most
_DRAWING_UNITS = {"m": (1e3, "mm"), "rad": (180 / np.pi, "°")}
"""Factors and units of dimensions, as in technical drawings."""
_ARROW = 0.13
"""Length of the largest error vector, as a share of the poses' extent."""


@present_kind.register
def present_calibration(found: Calibration, *, poses: Sequence[tuple[str, str]] = ()) -> r.Presentation:
    """Return the presentation of a calibration; `poses` are name and hash of every file of measured poses."""
    uses = [
        ("held-out poses" if k else "poses", name, sha256 or "not a file") for k, (name, sha256) in enumerate(poses)
    ]
    facts = [("model", found.chosen.name), ("seed", str(found.seed)), ("residual", found.fit.kind)]
    both, several = r.On.PRINTED, len(found.at().devices) > 1
    findings = [r.Chapter("findings", "Errors of the robot file", lambda: _list_findings(found), both)]
    of_tool = [
        r.Chapter("space", "Errors in space", lambda: _build_space(found)),
        r.Chapter("left", "Residuals by joint", lambda: _build_residuals(found)),
    ]
    sections = [
        *warn([r.end_sentence(r.capitalise(text)) for text in found.warnings]),
        r.Chapter("error", "Error before and after", lambda: _build_errors(found), r.On.DRAWN),
        r.Chapter("gain", "Error by model", lambda: _build_gain(found), both),
        *([r.Chapter("devices", "Devices and fixtures", lambda: _build_devices(found), both)] if several else []),
        *(findings if found.findings else []),
        *([] if found.at().of_encoders.all() else of_tool),
        r.Chapter("geometry", "Geometry", lambda: _build_geometry(found), r.On.DRAWN),
        r.Chapter(
            "stiffness",
            "Stiffness of the drives",
            lambda: _build_stiffness(found),
            r.On.ALL,
            when=bool(words.list_stiffness(found.parameter_rows())),
        ),
        r.Chapter("blind", "Not identifiable", lambda: _build_blind(found), both),
        r.Chapter("sensitivity", "Sensitivity", lambda: _build_sensitivity(found)),
    ]
    return r.Presentation(
        "Calibration from", found.poses.source, f"{found.robot.name}: calibration", words.describe_headline(found),
        words.describe_verdict(found), words.describe_inputs(found), sections, found.warnings, r.RobotPicture(found.robot),
        r.Provenance(facts, uses, found.robot), lambda: flatten_rows(found.parameter_rows()), found,
    )  # fmt: skip


def _build_errors(found: Calibration) -> Iterator[r.Element]:
    before, after = (found.errors(m) for m in (found.models[0], found.chosen))
    key = r.build_key(measured="robot file, device and target placed", predicted="calibrated")
    position = _draw_errors(before.distance[before.counted], after.distance[after.counted], "position error", "mm")
    yield r.Figures([position], "wide-chart", key, on=r.On.DRAWN)
    if before.angle is not None and after.angle is not None:
        yield r.Figures([_draw_errors(before.angle, after.angle, "orientation error", "mrad")], "wide-chart")
    held = (
        "at poses that took no part in the fit"
        if found.holdout is not None
        else "each pose predicted by a fit without it"
    )
    yield r.explain(f"Distance between measured and predicted tool, pose by pose, {held}, on a logarithmic scale.")


def _draw_errors(before: np.ndarray, after: np.ndarray, title: str, unit: str) -> r.Figure:
    """Return absolute errors pose by pose, before and after (thesis, figures 5.1, 5.9, 5.26)."""
    a, b = 1e3 * before, 1e3 * after
    index, values = np.arange(1, len(a) + 1), np.concatenate([a, b])
    values = values[np.isfinite(values) & (values > 0)]
    low, high = (float(values.min()), float(values.max())) if values.size else (1.0, 1.0)
    marks = r.Line(index, a, "measured thin"), r.Line(index, b), r.Dots(index, b, "pose")
    y = r.Axis(f"[{unit}]", (low / 1.3, high * 1.3), log=True)
    return r.Figure(r.Axis("unseen pose", (0.0, len(a) + 1.0)), y, marks, title, (1100, 260))


def _name(found: Calibration, k: int) -> tuple[str, str]:
    return words.describe_model(found.models[k], found.models[k - 1] if k else None)


def _build_gain(found: Calibration) -> Iterator[r.Element]:
    series = _build_steps(found)
    yield r.tabulate_things(
        series.rungs,
        r.Column(cell=lambda step: step.label),
        r.Column(kind="step", cell=series.draw),
        r.Column(kind="number", style="strong", cell=lambda step: step.rms),
        r.Column(style="about quiet", cell=lambda step: step.about[0]),
        state=lambda step: step.kind,
        style="waterfall",
    )
    yield r.explain(
        "RMS position error at held-out poses with its 95 % interval. Dashed: error expected from noise and the "
        "parameters' standard errors."
    )
    yield r.Text("Numbers", "heading")
    yield _build_sizes(found)
    if found.steps:
        tested = r.tabulate_things(
            found.steps,
            r.Column("model", cell=lambda s: s.name),
            r.Column("compared with", style="quiet", cell=lambda s: s.over),
            r.Column("rms before", "number", cell=lambda s: format_length(s.gain.rms_before)),
            r.Column("after", "number", cell=lambda s: format_length(s.gain.rms_after)),
            r.Column("p-value", "number", cell=lambda s: words.format_p_value(s.gain.p_value)),
            r.Column(style="quiet", cell=lambda s: "taken" if s.taken else "not better"),
        )
        said = "Cross-validation within the fitted poses. A larger model is selected if a paired test shows a smaller "
        yield r.Folded("All models tested", [tested, r.explain(f"{said}held-out error.")])


def _build_devices(found: Calibration) -> Iterator[r.Element]:
    """Yield one row for each device or fixture: measured quantity, accuracy, and error of its prediction."""
    at, errors, rows = found.at(), found.errors(found.chosen).distance, build_device_rows(found)

    def format_error(row: Mapping[str, Any], value: float) -> str:
        return format_angle(value) if row["unit"] == "rad" else format_length(value)

    def left(row: Mapping[str, Any]) -> str:
        own = errors[at.device == at.devices.index(row["name"])]
        return format_error(row, float(np.sqrt(np.nanmean(own**2))) / row.get("arc_radius", 1.0)) if len(own) else ""

    yield r.tabulate_things(
        rows,
        r.Column("device", cell=lambda row: str(row["name"])),
        r.Column("measures", style="quiet", cell=lambda row: words.MEASURED_KINDS[str(row["kind"])]),
        r.Column("fitted", "number", cell=lambda row: str(row["n"])),
        r.Column("noise", "number", cell=lambda row: format_error(row, row["noise"]) if row["noise"] else ""),
        r.Column("held out, rms", "number", "strong", cell=left),
        on=r.On.PRINTED,
    )
    arc = next((row["arc_radius"] for row in rows if "arc_radius" in row), None)
    yield r.explain(
        "Standard error of one measured number, estimated from the residuals. Measurements are weighed by it."
        + ("" if arc is None else f" In sums, errors of angles count as arcs of radius {format_length(arc)}.")
    )


def _build_sizes(found: Calibration) -> r.ResultTable:
    """Return one row for each model with the tool's error."""
    turned = found.errors(found.chosen).orientation_size is not None
    columns = [
        r.Column("model"),
        r.Column("adds", style="quiet", on=r.On.PAGE),
        r.Column("free", "number", on=r.On.TERMINAL),
        r.Column("fitted poses, mean", "number", on=r.On.PAGE),
        r.Column("held out, mean", "number", "strong"),
        r.Column("rms", "number", on=r.On.PAGE),
        r.Column("largest", "number"),
        *([r.Column("turned by", "number"), r.Column("largest", "number", on=r.On.PAGE)] if turned else []),
        r.Column("", "bar", on=r.On.TERMINAL),
    ]
    worst, rows = found.errors(found.models[0]).position_size.mean, []
    for k, model in enumerate(found.models):
        (name, adds), size, turn = (
            _name(found, k),
            found.errors(model).position_size,
            found.errors(model).orientation_size,
        )
        train = model.fit.errors(found.poses).position_size
        cells = [
            name,
            adds,
            str(model.fit.n_estimated),
            *(format_length(x) for x in (train.mean, size.mean, size.rms, size.max)),
        ]
        cells += ([format_angle(turn.mean), format_angle(turn.max)] if turn is not None else ["", ""]) if turned else []
        rows.append(r.Row([*cells, r.Bar(size.mean / worst)]))
    return r.ResultTable(columns, rows, on=r.On.PRINTED)


def _build_steps(found: Calibration) -> WaterfallSeries:
    """Return the waterfall in micrometres; the first bar is cut if it is much longer than all others."""
    rungs: list[WaterfallStep] = []
    for k, row in enumerate(found.to_dict()["waterfall"]):  # type: ignore[arg-type, var-annotated]
        label, adds = _name(found, k)
        left, (low, high) = 1e6 * float(row["rms"]), (1e6 * float(v) for v in row["ci95"])
        kind = "cause" if k else "start"
        previous = rungs[-1].left if rungs else float("nan")
        rungs.append(WaterfallStep(label, (adds,), kind, 0, (), left, low, high, previous, format_length(left / 1e6)))
    expected = found.predicted_error()
    floor = float("nan") if expected is None else 1e6 * expected
    if expected is not None:
        about = ("noise and the parameters' uncertainty",)
        text = format_length(expected)
        rungs.append(WaterfallStep("expected", about, "floor", 0, (), floor, floor, floor, float("nan"), text))
    others = max([row.high for row in rungs[1:]], default=rungs[0].high)
    end = 1.45 * others if rungs[0].high > 2.5 * others else 1.04 * rungs[0].high
    return WaterfallSeries("", tuple(rungs), floor, end)


def _list_findings(found: Calibration) -> Iterator[r.Element]:
    yield r.tabulate_things(
        found.findings,
        r.Column(cell=lambda f: r.Verdict("good" if f.status == "confirmed" else "care", "", f.status)),
        r.Column(on=r.On.PAGE, cell=lambda f: f.cause),
        r.Column(cell=_describe_finding),
        r.Column(on=r.On.PAGE, cell=lambda f: f.equation),
        style="findings",
        on=r.On.PRINTED,
    )
    yield r.explain("Each cause is removed from the model alone, and the rest is refitted.")


def _describe_finding(finding: Finding) -> str:
    why = finding.why_not_confirmed
    return f"{finding.sentence} Not confirmed: {why}." if why else finding.sentence


def _build_space(found: Calibration) -> Iterator[r.Element]:
    drawn = [(t, _draw_vectors(found, m)) for t, m in (("robot file", found.models[0]), ("calibrated", found.chosen))]
    pictures = [(title, picture) for title, picture in drawn if picture is not None]
    pictures = pictures[-1:] if len(found.models) == 1 else pictures
    drawings: list[r.Drawing] = [picture for _, picture in pictures]
    captions = [(title, f"errors drawn {picture.times:g} times their size") for title, picture in pictures]
    yield r.Figures(drawings, "spaces", captions=captions)
    yield r.explain(
        "Lines run from each measured pose along its error, measured minus predicted, in the robot's base frame, seen "
        "from the front right and above. Good: short lines in random directions."
    )


def _draw_vectors(found: Calibration, model: CandidateModel) -> r.VectorPicture | None:
    """Return the error vectors in the robot's base frame, the largest at a fixed share of the poses' extent."""
    places, error = found.locate_errors(model)
    ok = np.isfinite(error).all(axis=1)
    if not ok.any():
        return None
    places, error = places[ok], error[ok]
    extent = float(np.ptp(places, axis=0).max()) or 1.0
    largest = float(np.percentile(np.linalg.norm(error, axis=1), 95)) or 1.0
    return r.VectorPicture(places, error, _round_down(_ARROW * extent / largest))


def _round_down(x: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(x, 1e-9)))
    return float(power * max(m for m in (1, 2, 5) if m * power <= x * (1 + 1e-9)))


def _build_residuals(found: Calibration) -> Iterator[r.Element]:
    """Yield the residual over each joint's position, in which remaining cyclic or straightness errors are visible."""
    poses, error = found.at(), 1e6 * found.locate_errors(found.chosen)[1]
    axis = int(np.nanargmax(np.nanstd(error, axis=0))) if np.isfinite(error).any() else 0
    y, figures = error[:, axis], []
    ok = np.isfinite(y)
    for k, (joint, unit) in enumerate(zip(found.robot.actuated, found.robot.position_units, strict=True)):
        x = poses.q[ok, k]
        left = r.Axis(f"left along {'xyz'[axis]} [µm]", r.pad_limits(y[ok], np.zeros(1)))
        figures.append(
            r.Figure(r.Axis(f"q [{unit}]", r.pad_limits(x)), left, (r.Dots(x, y[ok], "pose"),), joint, (340, 200))
        )
    yield r.Figures(figures)
    yield r.explain(
        "The component with the largest residual. A wave over a joint's position is a cyclic error, a bow a "
        "straightness error."
    )


def _build_geometry(found: Calibration) -> Iterator[r.Element]:
    columns = [
        r.Column("parameter"), r.Column("nominal", "number", "quiet"), r.Column("calibrated", "number"), r.Column("", "unit"),
        r.Column("change ± standard error", "number", "strong"), r.Column("", "unit"), r.Column("", "interval"),
    ]  # fmt: skip
    groups: dict[str, list[dict[str, Any]]] = {}
    held = []
    for row in build_parameter_rows(found.fit):
        owner = str(row["name"]).rpartition(".")[0]
        if owner.startswith(("device", "tool")) or row["stderr"] is None:
            continue
        if row["determined"]:
            groups.setdefault(owner, []).append(row)
        else:
            held.append(str(row["name"]))
    shown = [(owner, [_build_dimension(row, rows) for row in rows]) for owner, rows in groups.items()]
    yield r.ResultTable(columns, groups=shown, style="geometry")
    yield r.explain(
        "± is one standard error (1 σ). The bar shows the change from nominal with its 95 % interval, each group on "
        "its own scale."
    )
    if held:
        yield r.explain(f"Determined by the robot file more than by these poses: {', '.join(held)}.")
    yield r.Text("Device and target", "heading")
    yield r.tabulate_plainly(map(_list_frame, build_frame_rows(found.fit)))
    yield r.tabulate_things(
        found.parameter_rows(),
        r.Column("dimension", cell=lambda row: row["name"]),
        r.Column("value", "number", cell=lambda row: r.format_with_uncertainty(row["value"], row["stderr"])),
        r.Column("unit", cell=lambda row: r.format_unit(row["unit"])),
        r.Column("95 % interval", "number", cell=_format_interval),
        r.Column(
            "nominal", "number", cell=lambda row: "" if row["nominal"] is None else r.format_number(row["nominal"], 6)
        ),
        state=lambda row: "" if row["determined"] else "care",
        on=r.On.NOTEBOOK,
    )


def _build_stiffness(found: Calibration) -> Iterator[r.Element]:
    yield r.tabulate_things(
        words.list_stiffness(found.parameter_rows()),
        r.Column("drive", cell=lambda row: row.joint),
        r.Column(
            "stiffness",
            "number",
            "strong",
            cell=lambda row: r.format_with_uncertainty(row.stiffness, row.stderr, row.unit),
        ),
        r.Column("95 % interval", "number", cell=lambda row: r.format_interval(row.ci95, row.stderr)),
        r.Column("compliance", "number", "quiet", cell=lambda row: row.compliance),
        on=r.On.ALL,
    )
    yield r.explain("The inverse of a drive's compliance; an interval that no compliance above zero bounds ends at ∞.")


def _build_dimension(row: dict[str, Any], group: list[dict[str, Any]]) -> r.Row:
    value, stderr = float(row["value"]), float(row["stderr"])
    nominal = 0.0 if row["nominal"] is None else float(row["nominal"])
    change = value - nominal
    factor, unit = _choose_unit(str(row["unit"]), max(abs(change), stderr))
    reach = (
        max(abs(float(other["value"]) - float(other["nominal"] or 0.0)) + 2 * float(other["stderr"]) for other in group)
        or 1e-300
    )
    low, high = ((end - nominal) / reach for end in row["ci95"])
    bar = r.IntervalBar(max(low, -1.0), min(high, 1.0), change / reach, 0.0, "", True)
    said = (
        f"{r.round_to_stderr(factor * change, factor * stderr)} ± {r.round_to_stderr(factor * stderr, factor * stderr)}"
    )
    times, drawing_unit = _DRAWING_UNITS.get(str(row["unit"]), (1.0, str(row["unit"])))
    cells = [
        str(row["name"]).rpartition(".")[2], r.format_number(round(times * nominal, 9) + 0.0, 6),
        r.round_to_stderr(times * value, times * stderr), drawing_unit if drawing_unit != "1" else "", said, unit, bar,
    ]  # fmt: skip
    return r.Row(cells)


def _choose_unit(unit: str, size: float) -> tuple[float, str]:
    """Return factor and unit of a change; dimensionless numbers are shown in 1e-6."""
    return {"1": (1e6, "10⁻⁶"), "m/N": (1e9, "nm/N")}.get(unit) or r.choose_unit(unit, size)


def _format_interval(row: dict[str, Any]) -> str:
    return r.format_interval(row["ci95"], row["stderr"]) if row["stderr"] and row["ci95"] else ""


def _list_frame(row: dict[str, Any]) -> list[str]:
    name = f"{'device' if row['frame'] == 'device' else 'target'}, campaign {row['campaign']}"
    name = row["device"] or (f"target {row['target']}" if row["target"] else name)
    if "zero" in row:
        zero = r.replace_minus_signs(f"{row['zero']:.6f}")
        return [name, f"zero {zero} {row['unit']}", ""]
    length = next((f"{key} {row[key]:.5f} m" for key in ("offset", "radius") if key in row), "")
    place, turn = ", ".join(f"{x:.5f}" for x in row["translation"]), ", ".join(f"{x:.6f}" for x in row["quaternion"])
    return [name, f"{r.replace_minus_signs(place)} m", length or f"quaternion {r.replace_minus_signs(turn)}"]


def _build_blind(found: Calibration) -> Iterator[r.Element]:
    identified = found.fit.identifiability
    blind: Any = identified.to_dict()["not_identifiable"]
    if blind:
        alike = {
            row["parameter"]: format_names(row["depends_on"], _MAX_NAMES) if row["depends_on"] else "" for row in blind
        }
        yield r.tabulate_plainly(
            (name, f"equivalent to a change of {others}" if others else "no effect on the tool")
            for name, others in alike.items()
        )
        said = "These keep their nominal value. Another value, with the named parameters adjusted, describes the same robot."
        yield r.explain(said)
    else:
        yield r.Text("Every free parameter is identifiable from these poses.")
    pairs: Any = list_correlated_pairs(found.fit)[:_MAX_CORRELATED]
    if pairs:
        yield r.Text("Strongly correlated", "heading")
        yield r.tabulate_plainly(
            [*c["parameters"], f"correlation {r.format_number(float(c['correlation']), 3)}"] for c in pairs
        )
    if len(identified.dropped):
        yield _list_blind([identified.names[k] for k in identified.dropped])


def _list_blind(names: Sequence[str]) -> r.Text:
    return r.Text(f"not identifiable, nominal value kept: {r.format_list(names, 8)}", "dim", on=r.On.TERMINAL)


def _build_sensitivity(found: Calibration) -> Iterator[r.Element]:
    each = 2 * max(int(found.fit.state.ok.sum()), 1)
    largest = sorted(compute_sensitivities(found.fit), key=lambda s: -s.position)[:_MAX_SENSITIVE]
    yield r.tabulate_things(
        [s for s in largest if s.position > 0],
        r.Column(f"parameter error of {1e6 * CHANGE:.0f} µm, µrad or 10⁻⁶", cell=lambda s: s.name),
        r.Column("moves the tool by", "number", "strong", cell=lambda s: format_length(s.position / each)),
        r.Column("turns it by", "number", cell=lambda s: format_angle(s.rotation / each) if s.rotation > 0 else "–"),
    )
    yield r.explain("On average over the fitted poses, with all loops closed.")


@present_kind.register
def present_campaign(plan: CalibrationCampaign) -> r.Presentation:
    """Return the presentation of the plan of a calibration."""
    return r.Presentation(
        "Calibration plan", "", "calibration plan", words.describe_plan(plan), None, words.describe_plan_inputs(plan),
        [r.Chapter("curve", "Accuracy by number of poses", lambda: _build_curve(plan), r.On.ALL)],
        data=lambda: [{"poses": row.poses, "rms": row.rms, "held_out": row.held_out} for row in plan.choice.curve], result=plan,
    )  # fmt: skip


def _build_curve(plan: CalibrationCampaign) -> Iterator[r.Element]:
    if plan.placement is not None:
        yield r.Text(words.describe_placement(plan.placement), on=r.On.ALL)
    yield r.Text(words.describe_rehearsal(plan), on=r.On.ALL)
    curve = plan.choice.curve
    step = max(1, -(-len(curve) // _MAX_PLANS))
    yield r.tabulate_things(
        [*curve[:-1:step], curve[-1]],
        r.Column("poses", "number", cell=lambda row: str(row.poses)),
        r.Column("tool", "number", cell=lambda row: format_length(row.rms)),
        r.Column("held out", "number", cell=lambda row: format_length(row.held_out)),
        on=r.On.ALL,
    )
    blind = list(plan.choice.not_identifiable)
    if blind:
        yield _list_blind(blind)
