"""A presentation as one self-contained HTML page: offline, light and dark, for screen and paper.

Its texts are escaped by Jinja. Its content security policy allows no network access and only the two included scripts, which
are identified by hash.
"""

from __future__ import annotations

import base64
import hashlib
import platform
from datetime import datetime
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tau_dyn import results as r
from tau_dyn.files import write_whole
from tau_dyn.render.markup import build_table, draw
from tau_dyn.render.presentation import present
from tau_dyn.render.sketch import build_joint_labels
from tau_dyn.render.time_view import build_payload, select_printed
from tau_dyn.version import __version__


def write_report(path: str | Path, result: Any, **options: Any) -> None:
    """Write the page of any result, atomically. Options are those of `build_page`.

    Example:
        >>> from pathlib import Path
        >>> td.write_report("robot.html", td.load_robot("linear_axis"))
        >>> Path("robot.html").read_text()[:15]
        '<!doctype html>'
    """
    write_whole(path, build_page(result, **options))


def build_page(result: Any, *, command_line: str = "", **options: Any) -> str:
    """Return any result as one HTML page.

    Args:
        result: The result, or its presentation.
        command_line: The command that repeats it, for the provenance.
        options: Options of `present` for this kind of result.
    """
    shown = result if isinstance(result, r.Presentation) else present(result, **options)
    sections = [(section, section.list_blocks(r.On.PAGE)) for section in shown.sections if section.on & r.On.PAGE]
    sections = [(section, blocks) for section, blocks in sections if blocks]
    every = r.spread_blocks(block for _, blocks in sections for block in blocks)
    views = [view for block in every if isinstance(block, r.TimeView) for view in block.views]
    picture = Markup("") if shown.picture is None else draw(shown.picture)
    return _environment().get_template("page.html.j2").render(
        shown=shown,
        sections=sections,
        picture=picture,
        joints_drawn=_list_joints_drawn(shown.picture) if picture else [],
        panels=build_payload(views),
        printed=select_printed(views),
        provenance=_list_facts(shown.provenance),
        command_line=command_line,
        style=Markup(_read("vendor/uPlot.min.css") + _read("templates/page.css")),  # noqa: S704
        scripts=[Markup(text) for text in list_scripts()],  # only files of this package, without content of the user
        script_hashes=[_hash(text) for text in list_scripts()],
        licence=_read("vendor/uPlot.LICENSE"),
    )  # fmt: skip


@cache
def _environment() -> Environment:
    loader = PackageLoader("tau_dyn.render", "templates")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters["together"] = lambda text: text.replace(" %", "\u00a0%").replace("± ", "±\u00a0")
    made.filters["table"] = lambda block: build_table(block, r.On.PAGE)
    made.filters["draw"] = draw
    made.tests["kind"] = lambda block, name: type(block).__name__ == name
    return made


@cache
def _read(name: str) -> str:
    return files("tau_dyn.render").joinpath(name).read_text(encoding="utf-8")


def list_scripts() -> list[str]:
    """Return the scripts of a page: the plotting library and the time view."""
    return [_read("vendor/uPlot.iife.min.js"), _read("templates/page.js")]


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def _list_joints_drawn(picture: Any) -> list[str]:
    """Return the legend of the numbers in a robot's picture; an empty list if the picture shows names."""
    if not isinstance(picture, r.RobotPicture):
        return []
    names = zip(build_joint_labels(picture.robot), picture.robot.actuated, strict=True)
    return [f"{number}\u00a0{joint}" for number, joint in names if number != joint]


def _list_facts(provenance: r.Provenance) -> list[tuple[str, str]]:
    """Return versions, the robot file, entries of the kind of result, and the date of the page."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("pin", "numpy", "scipy", "cvxpy"))
    facts = [("tau_dyn", __version__), ("libraries", f"Python {platform.python_version()}, {libraries}")]
    robot = provenance.robot
    if robot is not None:
        arguments = ", ".join(f"{k}:={v}" for k, v in robot.arguments.items())
        given = f" ({arguments})" if arguments else ""
        facts.append(("robot", f"{robot.source}{given}, actuated: {', '.join(robot.actuated)}"))
        facts.append(("robot file, SHA-256", robot.sha256 or "not a file"))
    made = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return [*facts, *provenance.facts, ("page made", made)]
