"""What `fk` and `ik` show: a table of positions and poses, on a page with the robot's picture and on the terminal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.table import Table

from tau_dyn.kinematics import PoseTable
from tau_dyn.report.html_page import PageHeader, render_page
from tau_dyn.report.terminal import (
    MARGIN,
    build_bare_table,
    escape_control_characters,
    measure_columns,
    put,
    say,
    say_written,
)

_ROWS_SHOWN = 200  # rows of a table on a page at most
_ROWS_PRINTED = 12  # rows of a table on a terminal at most


def build_kinematics_page(table: PoseTable, *, command_line: str = "") -> str:
    """Return positions and poses as one HTML page.

    Args:
        table: The answer.
        command_line: The command that repeats it, for the provenance.
    """
    answered, rows = int(table.ok.sum()), len(table.q)
    level = "good" if answered == rows else "care"
    every = "Answered" if rows == 1 else "All rows answered"
    badge = every if answered == rows else f"{answered} of {rows} answered"
    shown = _shown(table)
    return render_page(
        "kinematics.html.j2",
        f"{table.robot.name}: {_title(table).lower()}",
        PageHeader(f"{_headline(table)}.", level, badge, " ".join(f"{w}." for w in table.warnings), _summary(table)),
        [],
        robot=table.robot,
        command_line=command_line,
        kicker=_title(table),
        name=table.robot.name,
        single=_single(table) if rows == 1 else [],
        heads=[_heads(table)[k] for k in shown],
        rows=[[_cells(table, k, "{:.5f}")[c] for c in shown] for k in range(min(rows, _ROWS_SHOWN))],
        more=max(0, rows - _ROWS_SHOWN),
        assumed=table.robot.assumed,
    )


def _shown(table: PoseTable) -> list[int]:
    """Return the page's columns, what is told first; reasons only where there are some."""
    heads = _heads(table)
    why = heads.index("why not")
    kept = [k for k, head in enumerate(heads) if head in ("pose", "row", "signs", "mode")]
    rest = [k for k in range(len(heads)) if k not in (*kept, why)]
    return [*kept, *([] if table.ok.all() else [why]), *rest]


def _single(table: PoseTable) -> list[tuple[str, str, str, str]]:
    """Return one answer as rows: name, value, unit, and the limits of a joint."""
    robot = table.robot
    rows = [
        (name, _number(x), unit, f"{low:.6g} to {high:.6g}")
        for name, x, unit, low, high in zip(
            robot.actuated, table.q[0], robot.position_units, robot.lower, robot.upper, strict=True
        )
    ]
    tool = [(f"tool {axis}", _number(x), "m", "") for axis, x in zip("xyz", table.position[0], strict=True)]
    tool += [(f"tool q{axis}", _number(x), "", "") for axis, x in zip("xyzw", table.quaternion[0], strict=True)]
    return [*rows, *tool] if table.inverse else [*tool, *rows]


def print_poses(console: Console, table: PoseTable, written: Mapping[str, str] | None = None) -> None:
    """Print positions and poses for a person.

    Args:
        console: Where to.
        table: The answer.
        written: What was written, such as `{"report": "a.html"}`, for the last line.
    """
    say(console, _summary(table), "dim")
    say(console, f"{_headline(table)}.", "bold")
    if len(table.q) == 1:
        _print_one(console, table)
    else:
        for part in _parts(table, measure_columns(console)):
            put(console, part)
        if len(table.q) > _ROWS_PRINTED:
            say(console, f"and {len(table.q) - _ROWS_PRINTED} rows more; --out FILE.csv writes them all", "dim")
    say_written(console, written)


def _parts(table: PoseTable, width: int) -> list[Table]:
    """Return the first rows as tables no wider than the terminal; every one begins with the row's number."""
    heads, shown = _heads(table), min(len(table.q), _ROWS_PRINTED)
    cells = [_cells(table, row, "{:.4f}") for row in range(shown)]
    kept = [k for k, head in enumerate(heads) if head in ("pose", "row", "signs", "mode")]
    joints = [k for k in range(len(kept), len(kept) + table.robot.na)]
    place = [k for k, head in enumerate(heads) if head in ("x [m]", "y [m]", "z [m]")]
    turns = [heads.index(f"q{axis}") for axis in "xyzw"]
    why = [] if table.ok.all() else [heads.index("why not")]
    if table.inverse:  # the answer first; a pose that all rows share stands in the headline
        wanted = [*joints, *why, *([] if len(np.unique(table.pose)) == 1 else place)]
    else:
        one = len(table.counts) == 1  # its positions are known; orientations tell modes apart
        wanted = [*place, *turns, *why] if one else [*place, *why, *joints]
    widths = [max(len(head), *(len(row[k]) for row in cells)) + 2 for k, head in enumerate(heads)]
    parts: list[list[int]] = [[]]
    for k in wanted:
        used = sum(widths[i] for i in (*kept, *parts[-1])) + MARGIN[3]
        if parts[-1] and used + widths[k] > width:
            parts.append([])
        parts[-1].append(k)
    return [_part(heads, cells, [*kept, *part]) for part in parts]


def _part(heads: list[str], cells: list[list[str]], columns: list[int]) -> Table:
    printed = build_bare_table()
    for k in columns:
        printed.add_column(
            escape_control_characters(heads[k]), justify="left" if heads[k] == "why not" else "right", no_wrap=True
        )
    for row in cells:
        printed.add_row(*(row[k] for k in columns))
    return printed


def _print_one(console: Console, table: PoseTable) -> None:
    """Print one row as a list."""
    printed = Table.grid(padding=(0, 3, 0, 0))
    for justify in ("left", "right", "left"):
        printed.add_column(no_wrap=True, justify=justify)
    for cells in _single(table):
        printed.add_row(*(escape_control_characters(cell) for cell in cells[:3]))
    put(console, printed)


def _title(table: PoseTable) -> str:
    return "Inverse kinematics" if table.inverse else "Forward kinematics"


def _headline(table: PoseTable) -> str:
    rows, answered = len(table.q), int(table.ok.sum())
    if table.counts and not table.inverse:
        modes, asked = sum(c.count for c in table.counts), len(table.counts)
        found = "the count is proved" if table.complete else "found, the count is not proved"
        found = found if asked == 1 or table.complete else f"found, the count is proved for {_proved(table)} of {asked}"
        return f"{modes} assembly mode{'s' * (modes != 1)} of {asked} position{'s' * (asked != 1)}: {found}"
    if rows == 1 and not table.counts:
        x, y, z = (f"{v:.6g}" for v in table.position[0])
        return f"The tool {'gets to' if table.inverse else 'is at'} ({x}, {y}, {z}) m"
    if table.configuration.any():
        poses = len(table.counts)
        x, y, z = (f"{v:.6g}" for v in table.position[0])
        asked = f"1 pose, ({x}, {y}, {z}) m" if poses == 1 else f"{poses} poses"
        proved = "the count is proved" if table.complete else "found, the count is not proved"
        if poses > 1 and not table.complete:
            proved = f"found, the count is proved for {_proved(table)} of {poses}"
        return f"{rows} solution{'s' * (rows != 1)} for {asked}, {answered} within the joint limits: {proved}"
    return f"{answered} of {rows} {'poses can be reached' if table.inverse else 'positions have a pose'}"


def _summary(table: PoseTable) -> str:
    mode = "home's configuration and assembly mode"
    if table.counts:
        first = next((c for c in table.counts if not c.proved), table.counts[0])
        kind = "configurations" if table.inverse else "assembly modes"
        mode = f"all {kind} ({first.why})" if table.complete else f"{kind} that are found ({first.why})"
    return f"{_title(table)} of {table.robot.name}, {mode}; tool in the world frame."


def _proved(table: PoseTable) -> int:
    return sum(c.proved for c in table.counts)


def _choice(table: PoseTable) -> str:
    return "signs" if table.inverse else "mode"


def _heads(table: PoseTable) -> list[str]:
    kept = ["pose", *([_choice(table)] if table.configuration.any() else [])]
    joints = [f"{j} [{u}]" for j, u in zip(table.robot.actuated, table.robot.position_units, strict=True)]
    return [*kept, *joints, "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw", "why not"]


def _cells(table: PoseTable, k: int, digits: str = "{:.6f}") -> list[str]:
    kept = [str(table.pose[k]), *([table.configuration[k]] if table.configuration.any() else [])]
    numbers = [*table.q[k], *table.position[k], *table.quaternion[k]]
    return [*kept, *(_number(x, digits) for x in numbers), str(table.reason[k])]


def _number(x: float, digits: str = "{:.6f}") -> str:
    return digits.format(x) if np.isfinite(x) else ""
