"""The face of each result: what a colleague would look at first, in the words of its page."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.calibrate import Calibration
from tau_dyn.compare import Comparison
from tau_dyn.diagnose import Diagnosis
from tau_dyn.identify import Identification
from tau_dyn.kinematics import PoseTable
from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.kinematics.workspace import Study
from tau_dyn.log import Log, LogCheck
from tau_dyn.model import Model
from tau_dyn.modes import Modes, OperationalModes
from tau_dyn.parameters import Parameters
from tau_dyn.report import (
    accuracy_words,
    calibration_words,
    check_words,
    comparison,
    diagnosis_text,
    formatting,
    identification_charts,
    identification_words,
    modes_text,
    workspace_words,
)
from tau_dyn.report.accuracy_charts import draw_error_map
from tau_dyn.report.calibration_charts import draw_error_chart
from tau_dyn.report.force_series import decimate_min_max
from tau_dyn.report.formatting import count, format_list, format_number, format_percent, format_unit
from tau_dyn.report.modes_charts import draw_bode_chart, list_pairs
from tau_dyn.report.modes_model_charts import draw_operational_stabilisation_chart
from tau_dyn.report.notebook_face import Face, Row
from tau_dyn.report.notebook_tables import build_result_table
from tau_dyn.report.parameter_rows import build_parameter_rows
from tau_dyn.report.quantities import estimate, format_interval
from tau_dyn.report.robot_picture import draw_robot_picture
from tau_dyn.report.signature import draw_signature_charts
from tau_dyn.report.svg import Chart, format_tag, pad_limits
from tau_dyn.report.waterfall import build_total_series
from tau_dyn.report.workspace_charts import draw_section_chart
from tau_dyn.robot import Robot

_PICTURES = 4  # drawings shown at most


@singledispatch
def build_face(found: Any) -> Face:
    """Return how a result looks in a notebook."""
    raise TypeError(f"{type(found).__name__} has no face")


@build_face.register
def _log(found: Log) -> Face:
    size = count(found.n_samples, "sample")
    about = f"{found.name}, {format_number(found.duration)} s at {format_number(found.rate_hz)} Hz, {size}"
    rows = [Row([name, *_span(x)]) for name, x in found.channels.items()]
    first = [n for n in found.channels if n.startswith(("q_", "tau_"))] or list(found.channels)
    pictures = [_trace(found, name) for name in first[:_PICTURES]]
    return Face("Log", about, columns=("channel", "least", "mean", "most", "missing"), rows=rows, pictures=pictures,
                notes=found.warnings)  # fmt: skip


def _span(x: np.ndarray) -> list[str]:
    there = x[np.isfinite(x)]
    missing = str(x.size - there.size) if there.size < x.size else ""
    if not there.size:
        return ["", "", "", missing]
    return [*(format_number(float(v)) for v in (there.min(), there.mean(), there.max())), missing]


def _trace(log: Log, name: str) -> Markup:
    t, columns = decimate_min_max(log.t, log.channels[name][:, None], 400)
    y = columns[:, 0]
    chart = Chart(*identification_charts.SMALL, (float(t[0]), float(t[-1])), pad_limits(y), name, "t [s]", "")
    return chart.render(chart.line(t, y, "predicted"))


@build_face.register
def _parameters(found: Parameters) -> Face:
    rows = [Row([p.name, estimate(p), format_interval(p), p.origin], "" if p.free else "care") for p in found]
    about = f"{len(found)}, {sum(p.free for p in found)} of them free"
    return Face("Parameters", about, columns=("parameter", "value", "95 % interval", "from"), rows=rows)


@build_face.register
def _robot(found: Robot) -> Face:
    loops = f", {count(len(found.loops), 'closed loop')}" if found.loops else ""
    columns = ("actuated joint", "", "travel", "speed", "force")
    rows = [Row([r.joint, r.kind, f"{_limit(r.lower)} … {_limit(r.upper)} {r.position_unit}",
                 _up_to(r.velocity_limit, f"{r.position_unit}/s"), _up_to(r.effort_limit, r.force_unit)])
            for r in build_result_table(found).itertuples()]  # fmt: skip
    about = f"{found.name}, {count(found.na, 'actuated joint')}{loops}"
    return Face("Robot", about, columns=columns, rows=rows, pictures=[draw_robot_picture(found)], notes=found.warnings)


def _limit(x: float) -> str:
    return format_number(x, 3) if np.isfinite(x) else "no limit"


def _up_to(x: float, unit: str) -> str:
    return f"up to {format_number(x, 3)} {unit}" if np.isfinite(x) else ""


@build_face.register
def _model(found: Model) -> Face:
    equations = dict.fromkeys(f"{e.name}: {e.equation}" for e in found.effects)
    inner = _parameters(found.parameters)
    return Face(
        "Model", f"{found.robot.name}, {inner.about}", columns=inner.columns, rows=inner.rows, notes=[*equations]
    )


@build_face.register
def _identification(found: Identification) -> Face:
    judged, rows = identification_words.describe_verdict(found), build_parameter_rows(found)
    cells = [Row([r.name, r.estimate, r.unit, r.interval, r.nominal, identification_charts.draw_row_bar(r), r.note],
                 "" if r.state == "known" else "care") for r in rows]  # fmt: skip
    curves = identification_charts.build_friction_curves(found)
    return Face(
        "Identification",
        found.model.robot.name,
        identification_words.describe_headline(found),
        judged.level,
        formatting.format_recommendation(judged.level),
        ("parameter", "estimate", "unit", "95 % interval", "nominal", "", ""),
        cells,
        [identification_charts.draw_friction_chart(curve) for curve in curves[:_PICTURES]],
        [judged.sentence, *found.warnings],
    )


@build_face.register
def _diagnosis(found: Diagnosis) -> Face:
    level, badge = diagnosis_text.describe_badge(found)
    steps = build_total_series(found)
    rows = [
        Row(
            [
                r.label,
                _meter(steps.at(r.left)),
                format_percent(r.left) if np.isfinite(r.left) else "",
                format_list(r.joints),
            ]
        )
        for r in steps.rungs
    ]
    shown = [f.signature for f in found.findings if f.signature is not None]
    notes = [f"{diagnosis_text.format_title(f)} ({f.status}): {f.sentence}" for f in found.findings]
    return Face(
        "Diagnosis",
        f"{found.model.robot.name}, {format_list(found.outputs)}",
        found.sentence,
        level,
        badge,
        ("of what was measured is missed", "", "", ""),
        rows,
        [chart for signature in shown[:2] for chart in draw_signature_charts(signature)],
        [*notes, *found.warnings],
    )


def _meter(share: float) -> Markup:
    return format_tag("div", format_tag("i", style=f"width:{min(max(share, 0.0), 100.0):.1f}%"), class_="meter")


@build_face.register
def _modes(found: Modes) -> Face:
    charts = [draw_bode_chart(found, i, j) for i, j in list_pairs(found)[:_PICTURES]]
    return _modes_face(found, f"order {found.order}, {found.method}", charts)


@build_face.register
def _operational_modes(found: OperationalModes) -> Face:
    return _modes_face(found, "ssi-cov", [draw_operational_stabilisation_chart(found)])


def _modes_face(found: Modes | OperationalModes, how: str, charts: list[Markup]) -> Face:
    judged = modes_text.describe_verdict(found)
    rows = [
        Row(
            [
                modes_text.format_frequency(m),
                modes_text.format_interval(m.frequency_hz, m.frequency_stderr),
                modes_text.format_damping(m),
                modes_text.format_interval(100 * m.damping_ratio, 100 * m.damping_stderr),
            ]
        )
        for m in found.modes
    ]
    return Face(
        "Modes", how, modes_text.describe_headline(found), judged.level, modes_text.describe_badge(found),
        ("frequency [Hz]", "95 % interval", "damping [%]", "95 % interval"), rows, charts, [judged.sentence], ("modes_style",),
    )  # fmt: skip


@build_face.register
def _calibration(found: Calibration) -> Face:
    judged = calibration_words.describe_verdict(found)
    rows = [_dimension(row) for row in found.parameter_rows()]
    return Face(
        "Calibration", f"{found.robot.name}, model {found.chosen.name}", calibration_words.describe_headline(found), judged.level,
        formatting.format_recommendation(judged.level), ("dimension", "value", "unit", "95 % interval", "nominal"), rows,
        [draw_error_chart(found)], [judged.sentence, *found.warnings], ("calibration",),
    )  # fmt: skip


def _dimension(row: dict[str, Any]) -> Row:
    stderr, ends = row["stderr"], row["ci95"]
    between = (
        f"{formatting.round_to_stderr(ends[0], stderr)} … {formatting.round_to_stderr(ends[1], stderr)}"
        if stderr and ends
        else ""
    )
    nominal = "" if row["nominal"] is None else format_number(row["nominal"], 6)
    value = formatting.format_with_uncertainty(row["value"], stderr)
    return Row([row["name"], value, format_unit(row["unit"]), between, nominal], "" if row["determined"] else "care")


@build_face.register
def _check(found: LogCheck) -> Face:
    level = {"fault": "poor", "warning": "care", "ok": ""}
    rows = [
        Row([f.topic, f.severity, check_words.describe_check(f, found.name), f.remedy], level[f.severity])
        for f in check_words.order_worst_first(found)
    ]
    said = "good" if found.fit_for_use and not found.warnings else "care" if found.fit_for_use else "poor"
    return Face(
        "Check", found.name, check_words.check_headline(found), said, columns=("topic", "", "", "remedy"), rows=rows
    )


@build_face.register
def _workspace(found: Study) -> Face:
    judged, total = workspace_words.describe_verdict(found), found.workspace.code.size
    rows = [
        Row([r["reason"], format_percent(100 * r["points"] / total), format_list(r["culprits"], 4)])
        for r in found.workspace.counts()
    ]
    return Face(
        "Workspace", found.workspace.machine.robot.name, workspace_words.describe_headline(found), judged.level,
        workspace_words.describe_badge(judged.level), ("not in it because of", "share of the box looked at", ""), rows,
        [draw_section_chart(found, s) for s in found.sections[:_PICTURES]], [judged.sentence, *found.warnings], ("workspace",),
    )  # fmt: skip


@build_face.register
def _accuracy(found: AccuracyResult) -> Face:
    judged, badge = accuracy_words.describe_verdict(found)
    rows, pictures = [], []
    if found.accuracy is not None:
        for method in found.accuracy.largest:
            s = found.summary(method)
            rows.append(Row([method, *(accuracy_words.format_size(x) for x in (s.least, s.median, s.most))]))
        if found.grid is not None:
            pictures = [draw_error_map(found, found.accuracy.best_method)]
    return Face(
        "Accuracy", found.robot.name, accuracy_words.describe_headline(found), judged.level, badge,
        ("largest error by", "least", "median", "most"), rows, pictures, [judged.sentence, *found.measured.sentences],
        ("accuracy",),
    )  # fmt: skip


@build_face.register
def _poses(found: PoseTable) -> Face:
    frame = build_result_table(found)
    rows = [Row([_cell(x) for x in row], "" if row[-1] == "" else "poor") for row in frame.itertuples(index=False)]
    about = f"{found.robot.name}, {int(found.ok.sum())} of {count(len(rows), 'row')} with an answer"
    return Face("Poses", about, columns=list(frame.columns), rows=rows, notes=found.warnings)


def _cell(x: Any) -> str:
    return x if isinstance(x, str) else format_number(float(x), 6) if np.isfinite(x) else ""


@build_face.register
def _comparison(found: Comparison) -> Face:
    rows = [Row(list(comparison.list_cells(c)), "poor" if c.changed else "" if c.changed is False else "care")
            for c in comparison.order_changes(found)]  # fmt: skip
    notes = [f"{title}: {'; '.join(lines)}." for title, lines in comparison.list_circumstances(found)]
    return Face(
        "Comparison", f"{found.a.place} beside {found.b.place}", comparison.describe_headline(found),
        columns=("", "first", "second", "difference", "unit"), rows=rows,
        notes=[*notes, *comparison.list_undetermined(found), *comparison.list_findings(found), *found.warnings],
    )  # fmt: skip
