"""The page of `tau-dyn identify`: error by joint, forces over time, friction, every parameter, and why to trust it.

The page reads an `Identification` and computes nothing new.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tau_dyn.identify import ForceErrors, Identification
from tau_dyn.report import fit_quality_text, formatting, identification_charts
from tau_dyn.report.force_series import build_panels
from tau_dyn.report.html_page import PageHeader, list_logs_used, render_page
from tau_dyn.report.identification_words import describe_headline, describe_verdict
from tau_dyn.report.parameter_rows import build_parameter_rows, compute_bar_scale, group_rows
from tau_dyn.report.residuals import compute_residuals
from tau_dyn.report.time_view import build_force_view


def build_identification_page(
    found: Identification, *, command_line: str = "", truth: Mapping[str, float] | None = None
) -> str:
    """Return the report of an identification as one HTML page.

    Args:
        found: The result.
        command_line: The command that repeats it, for the provenance.
        truth: True parameter values by name, where the logs were simulated; adds a column.
    """
    residuals, curves = compute_residuals(found), identification_charts.build_friction_curves(found)
    rows, judged = build_parameter_rows(found, truth), describe_verdict(found, truth)
    robot = found.model.robot
    summary = fit_quality_text.describe_inputs(found) + "."
    return render_page(
        "identification.html.j2",
        f"{robot.name}: identified dynamics",
        PageHeader(
            describe_headline(found, truth),
            judged.level,
            formatting.format_recommendation(judged.level),
            judged.sentence,
            summary,
        ),
        [build_force_view(panel) for panel in build_panels(found)],
        robot=robot,
        provenance={"friction model": found.friction or "as the model file says", "seed": str(found.seed)},
        logs=list_logs_used(found.model.provenance),
        command_line=command_line,
        found=found,
        errors=_errors(found),
        friction=[identification_charts.draw_friction_chart(curve) for curve in curves],
        offsets=[text for text in map(identification_charts.describe_offset, curves) if text],
        equations=list(dict.fromkeys(effect.equation for effect in found.model.effects)),
        groups=group_rows(rows),
        known=sum(r.state == "known" for r in rows),
        n_parameters=len(rows),
        scale=formatting.format_percent(100 * compute_bar_scale(found.rows())),
        bar=identification_charts.draw_row_bar,
        truth=truth is not None,
        truth_words=fit_quality_text.describe_truth_errors(rows),
        whiteness=fit_quality_text.describe_whiteness(residuals),
        residuals=[
            (identification_charts.draw_histogram(r), identification_charts.draw_correlation_chart(r))
            for r in residuals
        ],
        trust=fit_quality_text,
    )


def _errors(found: Identification) -> list[dict[str, Any]]:
    """Return one line a joint: errors held out and in training, and a bar's length relative to the worst."""
    judged = found.holdout or found.train
    worst = max([*judged.per_joint_percent, *found.train.per_joint_percent], default=1.0) or 1.0
    units = found.model.robot.force_units
    return [
        {
            "joint": joint,
            "judged": _joint_error(judged, k, units[k]),
            "train": _joint_error(found.train, k, units[k]),
            "all": ""
            if judged.all_samples is None
            else formatting.format_percent(float(judged.all_samples.per_joint_percent[k])),
            "used": formatting.format_percent(100 * judged.used_shares[k]) if judged.used_shares else "",
            "width": 100 * judged.per_joint_percent[k] / worst,
            "train_at": 100 * found.train.per_joint_percent[k] / worst,
        }
        for k, joint in enumerate(judged.joints)
    ]


def _joint_error(errors: ForceErrors, k: int, unit: str) -> dict[str, str]:
    return {
        "percent": formatting.format_percent(float(errors.per_joint_percent[k])),
        "rms": f"{formatting.format_number(float(errors.rms[k]), 3)} {formatting.format_unit(unit)}",
    }
