"""One page that a person would rather look at than read: self-contained, offline, light and dark, on screen and on paper.

The page reads an `Identification` and computes nothing new. Its texts are escaped by Jinja; its content security policy
allows no network and no script but the two inside, which it names by hash.
"""

from __future__ import annotations

import base64
import hashlib
import platform
from collections.abc import Mapping
from datetime import datetime
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tau_dyn.files import write_whole
from tau_dyn.identify import ForceErrors, Identification
from tau_dyn.report import figures, trust, words
from tau_dyn.report.residuals import residuals_of
from tau_dyn.report.robot_picture import joint_labels, robot_picture
from tau_dyn.report.rows import Row, bar_scale, parameter_rows
from tau_dyn.report.series import Panel, panels, payload
from tau_dyn.version import __version__

PRINTED_PANELS = 12


def write_report(path: str | Path, found: Identification, **options: Any) -> None:
    """Write the page; it appears whole or not at all. Options are those of `identification_page`."""
    write_whole(path, identification_page(found, **options))


def identification_page(
    found: Identification, *, command_line: str = "", truth: Mapping[str, float] | None = None
) -> str:
    """Return the report of an identification as one HTML page.

    Args:
        found: The result.
        command_line: The command that repeats it, for the provenance.
        truth: True parameter values by name, where the logs were simulated; adds a column.
    """
    shown, residuals, curves = panels(found), residuals_of(found), figures.friction_curves(found)
    rows = parameter_rows(found, truth)
    return _environment().get_template("page.html.j2").render(
        found=found,
        robot=found.model.robot,
        title=f"{found.model.robot.name}: identified dynamics",
        headline=words.headline(found),
        verdict=words.verdict(found),
        summary=trust.summary_words(found),
        picture=robot_picture(found.model.robot),
        joints_drawn=_joints_drawn(found),
        errors=_errors(found),
        panels=payload(shown),
        printed=[(panel, figures.force_chart(panel)) for panel in _printed(shown)],
        friction=[figures.friction_chart(curve) for curve in curves],
        offsets=[text for text in map(figures.offset_words, curves) if text],
        equations=list(dict.fromkeys(effect.equation for effect in found.model.effects)),
        groups=[(name, list(members)) for name, members in groupby(rows, lambda r: r.group)],
        known=sum(r.state == "known" for r in rows),
        n_parameters=len(rows),
        scale=words.percent(100 * bar_scale(found.rows())),
        bar=_bar,
        truth=truth is not None,
        truth_words=trust.truth_words(rows),
        whiteness=trust.whiteness_words(residuals),
        residuals=[(figures.histogram_chart(r), figures.correlation_chart(r)) for r in residuals],
        trust=trust,
        provenance=_provenance(found),
        logs=_logs(found),
        command_line=command_line,
        words=words,
        style=Markup(_asset("vendor/uPlot.min.css") + _asset("templates/page.css")),  # noqa: S704
        scripts=[Markup(text) for text in _scripts()],  # noqa: S704
        script_hashes=[_hash(text) for text in _scripts()],
        licence=_asset("vendor/uPlot.LICENSE"),
    )  # fmt: skip


@cache
def _environment() -> Environment:
    loader = PackageLoader("tau_dyn.report", "templates")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters["together"] = lambda text: text.replace(" %", "\u00a0%").replace("± ", "±\u00a0")
    return made


@cache
def _asset(name: str) -> str:
    return files("tau_dyn.report").joinpath(name).read_text(encoding="utf-8")


def _scripts() -> list[str]:
    return [_asset("vendor/uPlot.iife.min.js"), _asset("templates/page.js")]


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def _printed(shown: list[Panel]) -> list[Panel]:
    """Return what paper shows: each joint once, in the first stretch, which is held out where there is one."""
    first = {panel.joint: panel for panel in reversed(shown)}
    return [panel for panel in shown if first[panel.joint] is panel][:PRINTED_PANELS]


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
            "width": 100 * judged.per_joint_percent[k] / worst,
            "train_at": 100 * found.train.per_joint_percent[k] / worst,
        }
        for k, joint in enumerate(judged.joints)
    ]


def _joints_drawn(found: Identification) -> list[str]:
    """Return what the numbers in the drawing stand for; nothing where it shows names."""
    robot = found.model.robot
    return [f"{n} {j}" for n, j in zip(joint_labels(robot), robot.actuated, strict=True) if n != j]


def _joint_error(errors: ForceErrors, k: int, unit: str) -> dict[str, str]:
    return {
        "percent": words.percent(float(errors.per_joint_percent[k])),
        "rms": f"{words.number(float(errors.rms[k]), 3)} {words.pretty_unit(unit)}",
    }


def _bar(row: Row) -> Markup:
    if row.bar is None:
        return Markup("")
    return figures.interval_bar(row.bar.low, row.bar.high, row.bar.at, row.bar.trust, row.state, bool(row.nominal))


def _logs(found: Identification) -> list[tuple[str, str, str]]:
    """Return each log's use, name and hash."""
    about = found.model.provenance
    pairs = (("trained on", about.get("trained_on", [])), ("held out", about.get("held_out", [])))
    return [(use, row["path"], row["sha256"] or "not a file") for use, rows in pairs for row in rows]


def _provenance(found: Identification) -> list[tuple[str, str]]:
    robot = found.model.robot
    arguments = ", ".join(f"{k}:={v}" for k, v in robot.arguments.items())
    libraries = ", ".join(f"{name} {version(name)}" for name in ("pin", "numpy", "scipy", "cvxpy"))
    return [
        ("tau_dyn", __version__),
        ("libraries", f"Python {platform.python_version()}, {libraries}"),
        ("robot", f"{robot.source}{f' ({arguments})' if arguments else ''}, actuated: {', '.join(robot.actuated)}"),
        ("robot file, SHA-256", robot.sha256 or "not a file"),
        ("friction model", found.friction or "as the model file says"),
        ("seed", str(found.seed)),
        ("page made", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")),
    ]
