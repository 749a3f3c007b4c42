"""What the terminal shows of a workspace: its size, what cuts it, the catalogue's figures, and where things are."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from tau_dyn.kinematics.workspace.maps import QUANTITIES
from tau_dyn.kinematics.workspace.study import Study
from tau_dyn.report.formatting import format_list, number, percent
from tau_dyn.report.terminal import bare_table, meter, plain, put, say, say_opening, say_written
from tau_dyn.report.workspace_words import headline, shown, summary, verdict

_BAR = 16  # columns of a bar


def print_workspace(console: Console, found: Study, written: Mapping[str, str] | None = None) -> None:
    """Print a workspace for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"report": "w.html"}`, for the last line.
    """
    judged = verdict(found)
    about = f"{found.workspace.machine.robot.name} · {summary(found)}"
    say_opening(console, about, headline(found), judged.level, judged.sentence)
    put(console, _reasons(found))
    put(console, _figures(found))
    say(console, f"Stiffness: {found.catalogue.elasticity}.", "dim")
    if found.sections:
        areas = [f"{s.name}: {number(s.area, 3)} m²" for s in found.sections]
        say(console, f"Cross-sections {format_list(areas)}.")
    if found.tilt is not None:
        rows = found.tilt.to_dict()
        say(
            console,
            f"Tilt: {rows['every_way_deg']:.0f}° towards every side, {rows['best_way_deg']:.0f}° towards the best.",
        )
    say_written(console, written)


def _reasons(found: Study) -> Table:
    table = bare_table()
    for title, justify in (("why not elsewhere", "left"), ("", "left"), ("share of box", "right"), ("most by", "left")):
        table.add_column(title, justify=justify)  # type: ignore[arg-type]
    for row in found.workspace.counts():
        most = format_list(
            [f"{name} {percent(100 * n / row['points'])}" for name, n in list(row["culprits"].items())[:2]]
        )
        table.add_row(*map(plain, [row["reason"], meter(row["share"], _BAR), percent(100 * row["share"]), most]))
    return table


def _figures(found: Study) -> Table:
    table = bare_table()
    for k, title in enumerate(("over the workspace", "least", "median", "largest", "at home")):
        table.add_column(title, justify="right" if k else "left", no_wrap=True)
    for name, (spread, home) in found.catalogue.rows.items():
        cells = [QUANTITIES[name].words, *(shown(name, v) for v in (*spread, home))]
        table.add_row(*map(plain, cells))
    return table
