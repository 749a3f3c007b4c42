"""What the terminal shows of a workspace: its size, what cuts it, the catalogue's figures, and where things are."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from tau_dyn.kinematics.workspace import QUANTITIES, Study
from tau_dyn.report.formatting import format_list, format_number, format_percent
from tau_dyn.report.terminal import (
    build_bare_table,
    draw_meter,
    escape_control_characters,
    put,
    say,
    say_opening,
    say_written,
)
from tau_dyn.report.workspace_words import describe_headline, describe_inputs, describe_verdict, format_shown_value

_BAR = 16  # columns of a bar


def print_workspace(console: Console, found: Study, written: Mapping[str, str] | None = None) -> None:
    """Print a workspace for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "w.html"}`, for the last line.
    """
    judged = describe_verdict(found)
    about = f"{found.workspace.machine.robot.name} · {describe_inputs(found)}"
    say_opening(console, about, describe_headline(found), judged.level, judged.sentence)
    put(console, _reasons(found))
    put(console, _figures(found))
    say(console, f"Stiffness: {found.catalogue.elasticity}.", "dim")
    if found.sections:
        areas = [f"{s.name}: {format_number(s.area, 3)} m²" for s in found.sections]
        say(console, f"Cross-sections {format_list(areas)}.")
    if found.tilt is not None:
        rows = found.tilt.to_dict()
        say(
            console,
            f"Tilt: {rows['every_way_deg']:.0f}° towards every side, {rows['best_way_deg']:.0f}° towards the best.",
        )
    say_written(console, written)


def _reasons(found: Study) -> Table:
    table = build_bare_table()
    for title, justify in (("why not elsewhere", "left"), ("", "left"), ("share of box", "right"), ("most by", "left")):
        table.add_column(title, justify=justify)  # type: ignore[arg-type]
    for row in found.workspace.counts():
        most = format_list(
            [f"{name} {format_percent(100 * n / row['points'])}" for name, n in list(row["culprits"].items())[:2]]
        )
        table.add_row(
            *map(
                escape_control_characters,
                [row["reason"], draw_meter(row["share"], _BAR), format_percent(100 * row["share"]), most],
            )
        )
    return table


def _figures(found: Study) -> Table:
    table = build_bare_table()
    for k, title in enumerate(("over the workspace", "least", "median", "largest", "at home")):
        table.add_column(title, justify="right" if k else "left", no_wrap=True)
    for name, (spread, home) in found.catalogue.rows.items():
        cells = [QUANTITIES[name].words, *(format_shown_value(name, v) for v in (*spread, home))]
        table.add_row(*map(escape_control_characters, cells))
    return table
