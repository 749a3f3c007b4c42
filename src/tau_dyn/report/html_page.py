"""What every page shares: the template environment, style, scripts, the time view, and where it was made.

A page is one file that needs no other: offline, light and dark, on screen and on paper. Its texts are escaped by Jinja; its
content security policy allows no network and no script but the two inside, which it names by hash.
"""

from __future__ import annotations

import base64
import hashlib
import platform
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tau_dyn.report import formatting
from tau_dyn.report.robot_picture import build_joint_labels, draw_robot_picture
from tau_dyn.report.time_view import View, build_payload, select_printed
from tau_dyn.robot import Robot
from tau_dyn.version import __version__


class PageHeader(NamedTuple):
    """What stands on top of a page.

    Attributes:
        headline: The one sentence above everything.
        level: `good`, `care` or `poor`.
        badge: The judgement in a word or three.
        judgement: What it means, in a sentence.
        summary: What went in.
    """

    headline: str
    level: formatting.Level
    badge: str
    judgement: str
    summary: str


def render_page(
    template: str,
    title: str,
    opening: PageHeader,
    views: Sequence[View],
    *,
    robot: Robot | None = None,
    provenance: Mapping[str, str] | None = None,
    logs: Sequence[tuple[str, str, str]] = (),
    command_line: str = "",
    named: Collection[str] = (),
    **content: Any,
) -> str:
    """Return a page.

    Args:
        template: File name of its template.
        title: Of the window.
        opening: What stands on top.
        views: The time view; empty for none.
        robot: Whose picture stands in the header; None for no picture.
        provenance: What else the last section says, besides versions and the robot file.
        logs: Use, name and hash of each log.
        command_line: The command that repeats it.
        named: Joints that the picture shows in another colour.
        content: Whatever else the template asks for.
    """
    return _environment().get_template(template).render(
        title=title,
        **opening._asdict(),
        robot=robot,
        picture=Markup("") if robot is None else draw_robot_picture(robot, named),
        joints_drawn=[] if robot is None else _joints_drawn(robot),
        panels=build_payload(views),
        printed=select_printed(views),
        provenance=[*_made_with(), *([] if robot is None else _robot_file(robot)), *(provenance or {}).items(), _made_on()],
        logs=list(logs),
        command_line=command_line,
        words=formatting,
        style=Markup(_asset("vendor/uPlot.min.css") + _asset("templates/page.css")),  # noqa: S704
        scripts=[Markup(text) for text in _scripts()],  # our own files, nothing of the user's
        script_hashes=[_hash(text) for text in _scripts()],
        licence=_asset("vendor/uPlot.LICENSE"),
        **content,
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


def list_logs_used(provenance: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return use, name and hash of each log that a model's provenance names."""
    pairs = (("training", provenance.get("trained_on", [])), ("held out", provenance.get("held_out", [])))
    return [(use, row["path"], row["sha256"] or "held in memory") for use, rows in pairs for row in rows]


def _joints_drawn(robot: Robot) -> list[str]:
    """Return what the numbers in the drawing stand for; nothing where it shows names."""
    return [f"{n} {j}" for n, j in zip(build_joint_labels(robot), robot.actuated, strict=True) if n != j]


def _made_with() -> list[tuple[str, str]]:
    libraries = ", ".join(f"{name} {version(name)}" for name in ("pin", "numpy", "scipy", "cvxpy"))
    return [("tau_dyn", __version__), ("libraries", f"Python {platform.python_version()}, {libraries}")]


def _robot_file(robot: Robot) -> list[tuple[str, str]]:
    arguments = ", ".join(f"{k}:={v}" for k, v in robot.arguments.items())
    return [
        ("robot", f"{robot.source}{f' ({arguments})' if arguments else ''}, actuated: {', '.join(robot.actuated)}"),
        ("robot file, SHA-256", robot.sha256 or "not a file"),
    ]


def _made_on() -> tuple[str, str]:
    return "page made", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
