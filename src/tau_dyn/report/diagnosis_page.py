"""The page of `tau-dyn diagnose`: what the simulation gets wrong, which cause explains it, and how much better it is then.

The answer stands first, then the waterfall, one card a finding, what stays unexplained, the forces over time, the parameters,
and last why to trust it. The page reads a `Diagnosis` and judges nothing new.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tau_dyn.diagnose import Diagnosis, Finding, TimeTrace, Unexplained
from tau_dyn.report import diagnosis_text, formatting, identification_charts, quantities, waterfall as fall
from tau_dyn.report.diagnosis_rows import build_diagnosed_rows
from tau_dyn.report.force_series import compute_limits
from tau_dyn.report.html_page import PageHeader, list_logs_used, render_page
from tau_dyn.report.parameter_rows import group_rows
from tau_dyn.report.signature import draw_signature_charts
from tau_dyn.report.time_view import Curve, Strip, View

PARTS = {1: "confirm", 2: "held"}
"""How the time view shades what each part of the data served; what was trained on stays plain."""


def build_diagnosis_page(diagnosis: Diagnosis, *, command_line: str = "") -> str:
    """Return a diagnosis as one HTML page.

    Args:
        diagnosis: The result.
        command_line: The command that repeats it, for the provenance.
    """
    robot, (level, badge) = diagnosis.model.robot, diagnosis_text.describe_badge(diagnosis)
    rows, scale = build_diagnosed_rows(diagnosis)
    said = diagnosis_text.recommend_model(diagnosis).sentence
    return render_page(
        "diagnosis.html.j2",
        f"{robot.name}: diagnosis",
        PageHeader(diagnosis.sentence, level, badge, said, diagnosis_text.describe_inputs(diagnosis)),
        [_view(diagnosis, trace, k) for trace in diagnosis.traces for k in range(len(diagnosis.outputs))],
        robot=robot,
        provenance={"seed": str(diagnosis.seed)},
        logs=list_logs_used(diagnosis.model.provenance),
        command_line=command_line,
        named=_joints(diagnosis),
        found=diagnosis,
        whole=fall.build_total_series(diagnosis),
        parts=fall.build_output_series(diagnosis),
        spread=fall.format_interval,
        cards=[_card(diagnosis, finding) for finding in diagnosis.findings],
        open_ends=[_open_end(item) for item in diagnosis.unexplained],
        simulated=diagnosis_text.list_simulation_rows(diagnosis.simulation),
        settings=diagnosis_text.list_settings(diagnosis.settings),
        groups=group_rows(rows),
        scale=formatting.format_percent(100 * scale),
        bar=identification_charts.draw_row_bar,
        said=diagnosis_text,
        shares=_shares(diagnosis),
    )


def _joints(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the joints that the answer is about: those of confirmed causes, else of what is suspected or unexplained."""
    confirmed = [f for f in diagnosis.findings if f.status == "confirmed"]
    found = [j for f in (confirmed or diagnosis.findings) for j in f.joints]
    return tuple(dict.fromkeys(found or [u.joint for u in diagnosis.unexplained]))


def _card(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    return {
        "finding": finding,
        "title": diagnosis_text.format_title(finding),
        "level": diagnosis_text.STATUS_LEVEL[finding.status],
        "parameters": [(p.name, quantities.estimate(p), quantities.format_interval(p)) for p in finding.parameters],
        "gain": diagnosis_text.describe_gain(finding.gain, _unit(diagnosis, finding)),
        "charts": [] if finding.signature is None else draw_signature_charts(finding.signature),
    }


def _unit(diagnosis: Diagnosis, finding: Finding) -> str:
    """Return the unit of a finding's residual; empty where its outputs have several."""
    units = {u for o, u in zip(diagnosis.outputs, diagnosis.units, strict=True) if o in finding.joints}
    units = units or set(diagnosis.units)
    return units.pop() if len(units) == 1 else ""


def _open_end(item: Unexplained) -> dict[str, Any]:
    charts = [] if item.signature is None else draw_signature_charts(item.signature, explained=False)
    return {"item": item, "level": diagnosis_text.STATUS_LEVEL[item.status], "charts": charts}


def _view(diagnosis: Diagnosis, trace: TimeTrace, k: int) -> View:
    """Return one output's measurement, both models, and what each leaves, in a unit that reads well."""
    used = trace.usable[:, k]
    three = np.column_stack([trace.measured[:, k], trace.before[:, k], trace.after[:, k]])
    size = float(np.max(np.abs(three[used]), initial=0.0))
    factor, unit = quantities.choose_unit(diagnosis.units[k], size)
    measured, before, after = factor * three.T
    above = Strip(
        f"{diagnosis.channel} [{unit}]",
        (
            Curve("measured", "measured", measured),
            Curve("before", "residual", before),
            Curve("after", "predicted", after),
        ),
        compute_limits(np.concatenate([x[used] for x in (measured, before, after)])),
        270,
    )
    left = np.concatenate([(measured - before)[used], (measured - after)[used]])
    below = Strip(
        f"residual [{unit}]",
        (Curve("before", "residual", measured - before), Curve("after", "predicted", measured - after)),
        compute_limits(np.concatenate([left, -left]), 0.1),
        200,
        masked=True,
    )
    seen = set(np.unique(trace.part).tolist())
    return View(trace.log, diagnosis.outputs[k], trace.t, (above, below), seen <= set(PARTS), _bands(trace), used)


def _bands(trace: TimeTrace) -> tuple[tuple[float, float, str], ...]:
    """Return the stretches that were kept for confirming and for measuring the gain."""
    edges = np.flatnonzero(np.diff(trace.part)) + 1
    starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [len(trace.t) - 1]])
    kinds = [PARTS.get(int(trace.part[start])) for start in starts]
    stretches = zip(trace.t[starts], trace.t[stops], kinds, strict=True)
    return tuple((float(start), float(stop), ink) for start, stop, ink in stretches if ink)


def _shares(diagnosis: Diagnosis) -> list[tuple[str, str, float]]:
    """Return name, seconds and share [%] of each part of the data."""
    whole = sum(diagnosis.n_parts) or 1.0
    names = ("train", "confirm", "held")
    return [
        (name, f"{formatting.format_number(s, 3)} s", 100 * s / whole)
        for name, s in zip(names, diagnosis.n_parts, strict=True)
    ]
