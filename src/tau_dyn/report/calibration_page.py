"""The page of `tau-dyn calibrate`: error before and after, what each model gained, the geometry, and what no pose can tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from tau_dyn.calibrate import (
    CHANGE,
    Calibration,
    build_frame_rows,
    build_parameter_rows,
    compute_sensitivities,
    list_correlated_pairs,
)
from tau_dyn.report import calibration_charts as charts
from tau_dyn.report.calibration_words import (
    describe_finding,
    describe_headline,
    describe_inputs,
    describe_model,
    describe_verdict,
    format_angle,
    format_length,
)
from tau_dyn.report.formatting import format_number, format_recommendation, replace_minus_signs, round_to_stderr
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.identification_charts import draw_interval_bar
from tau_dyn.report.quantities import choose_unit
from tau_dyn.report.waterfall import WaterfallSeries, WaterfallStep

_CORRELATED = 12  # pairs listed at most
_SENSITIVE = 12  # parameters listed at most


def build_calibration_page(found: Calibration, *, poses: Sequence[tuple[str, str]] = (), command_line: str = "") -> str:
    """Return a calibration as one HTML page.

    Args:
        found: The result.
        poses: Name and hash of every file of poses.
        command_line: The command that repeats it, for the provenance.
    """
    judged = describe_verdict(found)
    opening = PageHeader(
        describe_headline(found),
        judged.level,
        format_recommendation(judged.level),
        judged.sentence,
        describe_inputs(found),
    )
    turned = found.errors(found.chosen).rotation is not None
    return render_page(
        "calibration.html.j2",
        f"{found.robot.name}: calibration",
        opening,
        [],
        robot=found.robot,
        logs=[
            ("held-out poses" if k else "poses", name, sha256 or "not a file") for k, (name, sha256) in enumerate(poses)
        ],
        command_line=command_line,
        provenance={"model": found.chosen.name, "seed": str(found.seed), "residual": found.fit.kind},
        name=found.poses.source,
        found=found,
        errors=charts.draw_error_chart(found),
        turns=charts.draw_error_chart(found, turned=True) if turned else Markup(""),
        sizes=[_sizes(found, k) for k in range(len(found.models))],
        vectors=charts.draw_vector_pictures(found),
        ladder=_ladder(found),
        tried=_tried(found),
        findings=[(f, describe_finding(f)) for f in found.findings],
        groups=_parameters(found),
        frames=[_frame(row) for row in build_frame_rows(found.fit)],
        blind=found.fit.identifiability.to_dict()["not_identifiable"],
        pairs=[
            (c["parameters"], format_number(float(c["correlation"]), 3))  # type: ignore[arg-type]
            for c in list_correlated_pairs(found.fit)[:_CORRELATED]
        ],
        left=charts.draw_residuals_along_joints(found),
        sensitive=_sensitive(found),
        change=f"{1e6 * CHANGE:.0f}",
    )


def _sizes(found: Calibration, k: int) -> dict[str, str]:
    model = found.models[k]
    name, adds = describe_model(model, found.models[k - 1] if k else None)
    size, turn = found.errors(model).position_size, found.errors(model).orientation_size
    train = model.fit.errors(found.poses).position_size
    return {
        "name": name,
        "adds": adds,
        "train": format_length(train.mean),
        "mean": format_length(size.mean),
        "rms": format_length(size.rms),
        "max": format_length(size.max),
        "turned": "" if turn is None else format_angle(turn.mean),
        "turned_max": "" if turn is None else format_angle(turn.max),
    }


def _ladder(found: Calibration) -> WaterfallSeries:
    """Return the waterfall in micrometres; the first bar is cut where it dwarfs all others."""
    rungs: list[WaterfallStep] = []
    for k, row in enumerate(found.to_dict()["waterfall"]):  # type: ignore[arg-type, var-annotated]
        label, adds = describe_model(found.models[k], found.models[k - 1] if k else None)
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
    others = max([r.high for r in rungs[1:]], default=rungs[0].high)
    end = 1.45 * others if rungs[0].high > 2.5 * others else 1.04 * rungs[0].high
    return WaterfallSeries("", tuple(rungs), floor, end)


def _tried(found: Calibration) -> list[dict[str, str]]:
    return [
        {
            "name": s.name,
            "over": s.over,
            "before": format_length(s.gain.before),
            "after": format_length(s.gain.after),
            "p": "< 0.001" if s.gain.p_value < 1e-3 else format_number(s.gain.p_value, 2),
            "taken": "taken" if s.taken else "not better",
        }
        for s in found.steps
    ]


def _parameters(found: Calibration) -> list[tuple[str, list[dict[str, Any]]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in build_parameter_rows(found.fit):
        owner = str(row["name"]).rpartition(".")[0]
        if owner.startswith(("device", "tool")) or row["stderr"] is None:
            continue
        groups.setdefault(owner, []).append(row)
    return [(owner, [_shown(row, rows) for row in rows]) for owner, rows in groups.items()]


def _shown(row: dict[str, Any], group: list[dict[str, Any]]) -> dict[str, Any]:
    value, stderr = float(row["value"]), float(row["stderr"])
    nominal = 0.0 if row["nominal"] is None else float(row["nominal"])
    change = value - nominal
    factor, unit = _unit(str(row["unit"]), max(abs(change), stderr))
    reach = max(
        max(abs(float(r["value"]) - float(r["nominal"] or 0.0)) + 2 * float(r["stderr"]) for r in group), 1e-300
    )
    low, high = row["ci95"]
    bar = draw_interval_bar(
        max((low - nominal) / reach, -1.0),
        min((high - nominal) / reach, 1.0),
        change / reach,
        0.0,
        "" if row["determined"] else "weak",
        True,
    )
    return {
        "name": str(row["name"]).rpartition(".")[2],
        "value": round_to_stderr(value, stderr),
        "in": str(row["unit"]) if row["unit"] != "1" else "",
        "nominal": format_number(round(nominal, 12) + 0.0, 6),
        "change": f"{round_to_stderr(factor * change, factor * stderr)} ± {round_to_stderr(factor * stderr, factor * stderr)}",
        "unit": unit,
        "bar": bar,
        "weak": not row["determined"],
    }


def _unit(unit: str, size: float) -> tuple[float, str]:
    """Return factor and unit of a change; bare numbers are shown in millionths."""
    if unit == "1":
        return 1e6, "10⁻⁶"
    if unit == "m/N":
        return 1e9, "nm/N"
    return choose_unit(unit, size)


def _frame(row: dict[str, object]) -> dict[str, str]:
    translation: Any = row["translation"]
    quaternion: Any = row["quaternion"]
    return {
        "name": f"target {row['target']}"
        if row["target"]
        else f"{'device' if row['frame'] == 'device' else 'target'}, campaign {row['campaign']}",
        "translation": replace_minus_signs(", ".join(f"{x:.5f}" for x in translation)),
        "quaternion": replace_minus_signs(", ".join(f"{x:.6f}" for x in quaternion)),
    }


def _sensitive(found: Calibration) -> list[dict[str, str]]:
    rows = sorted(compute_sensitivities(found.fit), key=lambda s: -s.position)[:_SENSITIVE]
    each = 2 * max(int(found.fit.state.ok.sum()), 1)
    return [
        {
            "name": s.name,
            "position": format_length(s.position / each),
            "rotation": format_angle(s.rotation / each) if s.rotation > 0 else "–",
        }
        for s in rows
        if s.position > 0
    ]
