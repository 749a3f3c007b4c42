"""The page of `tau-dyn identify`: error by joint, forces over time, friction, every parameter, and why to trust it.

The page reads an `Identification` and computes nothing new.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tau_dyn.identify import ForceErrors, Identification
from tau_dyn.report import figures, trust, words
from tau_dyn.report.identification_words import headline, verdict
from tau_dyn.report.residuals import residuals_of
from tau_dyn.report.rows import bar_scale, grouped, parameter_rows
from tau_dyn.report.series import panels
from tau_dyn.report.shell import Opening, logs_used, render
from tau_dyn.report.time_view import force_view


def identification_page(
    found: Identification, *, command_line: str = "", truth: Mapping[str, float] | None = None
) -> str:
    """Return the report of an identification as one HTML page.

    Args:
        found: The result.
        command_line: The command that repeats it, for the provenance.
        truth: True parameter values by name, where the logs were simulated; adds a column.
    """
    residuals, curves = residuals_of(found), figures.friction_curves(found)
    rows, judged = parameter_rows(found, truth), verdict(found, truth)
    robot = found.model.robot
    summary = trust.summary_words(found) + ("." if truth else ". “Known to ±” is the 95 % interval.")
    return render(
        "identification.html.j2",
        f"{robot.name}: identified dynamics",
        Opening(headline(found, truth), judged.level, words.badge(judged.level), judged.sentence, summary),
        [force_view(panel) for panel in panels(found)],
        robot=robot,
        provenance={"friction model": found.friction or "as the model file says", "seed": str(found.seed)},
        logs=logs_used(found.model.provenance),
        command_line=command_line,
        found=found,
        errors=_errors(found),
        friction=[figures.friction_chart(curve) for curve in curves],
        offsets=[text for text in map(figures.offset_words, curves) if text],
        equations=list(dict.fromkeys(effect.equation for effect in found.model.effects)),
        groups=grouped(rows),
        known=sum(r.state == "known" for r in rows),
        n_parameters=len(rows),
        scale=words.percent(100 * bar_scale(found.rows())),
        bar=figures.row_bar,
        truth=truth is not None,
        truth_words=trust.truth_words(rows),
        whiteness=trust.whiteness_words(residuals),
        residuals=[(figures.histogram_chart(r), figures.correlation_chart(r)) for r in residuals],
        trust=trust,
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
            "all": "" if judged.all_samples is None else words.percent(float(judged.all_samples.per_joint_percent[k])),
            "used": words.percent(100 * judged.used_shares[k]) if judged.used_shares else "",
            "width": 100 * judged.per_joint_percent[k] / worst,
            "train_at": 100 * found.train.per_joint_percent[k] / worst,
        }
        for k, joint in enumerate(judged.joints)
    ]


def _joint_error(errors: ForceErrors, k: int, unit: str) -> dict[str, str]:
    return {
        "percent": words.percent(float(errors.per_joint_percent[k])),
        "rms": f"{words.number(float(errors.rms[k]), 3)} {words.pretty_unit(unit)}",
    }
