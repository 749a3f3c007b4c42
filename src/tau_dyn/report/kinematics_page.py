"""What `fk` and `ik` show: a table of positions and poses, on a page with the robot's picture and on the terminal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rich.console import Console

from tau_dyn.kinematics.pose_table import PoseTable
from tau_dyn.report.shell import Opening, render
from tau_dyn.report.terminal import bare_table, put, say

_ROWS_SHOWN = 200
_ROWS_PRINTED = 12


def kinematics_page(table: PoseTable, *, command_line: str = "") -> str:
    """Return positions and poses as one HTML page.

    Args:
        table: The answer.
        command_line: The command that repeats it, for the provenance.
    """
    answered, rows = int(table.ok.sum()), len(table.q)
    level = "good" if answered == rows else "care"
    badge = "All rows answered" if answered == rows else f"{rows - answered} without answer"
    return render(
        "kinematics.html.j2",
        f"{table.robot.name}: {_title(table).lower()}",
        Opening(f"{_headline(table)}.", level, badge, " ".join(f"{w}." for w in table.warnings), _summary(table)),
        [],
        robot=table.robot,
        command_line=command_line,
        kicker=_title(table),
        name=table.robot.name,
        heads=_heads(table),
        rows=[_cells(table, k) for k in range(min(rows, _ROWS_SHOWN))],
        more=max(0, rows - _ROWS_SHOWN),
        assumed=table.robot.assumed,
    )


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
        printed = bare_table()
        heads = _heads(table)
        wanted = [k for k, head in enumerate(heads) if head not in ("qx", "qy", "qz", "qw")]  # the table has them
        for k in wanted:
            printed.add_column(heads[k], justify="left" if heads[k] == "why not" else "right")
        for row in range(min(len(table.q), _ROWS_PRINTED)):
            cells = _cells(table, row, "{:.4f}")
            printed.add_row(*(cells[k] for k in wanted))
        put(console, printed)
        if len(table.q) > _ROWS_PRINTED:
            say(console, f"and {len(table.q) - _ROWS_PRINTED} rows more; --out FILE.csv writes them all", "dim")
    if written:
        say(console, "   ".join(f"{what} → {path}" for what, path in written.items()))


def _print_one(console: Console, table: PoseTable) -> None:
    """Print one row as a list."""
    rows = bare_table()
    for _ in range(3):
        rows.add_column("", no_wrap=True)
    for name, x, unit in zip(table.robot.actuated, table.q[0], table.robot.position_units, strict=True):
        rows.add_row(name, _number(x), unit)
    for name, x in zip(("x", "y", "z"), table.position[0], strict=True):
        rows.add_row(f"tool {name}", _number(x), "m")
    rows.add_row("quaternion", " ".join(_number(x) for x in table.quaternion[0]), "x y z w")
    put(console, rows)


def _title(table: PoseTable) -> str:
    return "Inverse kinematics" if table.inverse else "Forward kinematics"


def _headline(table: PoseTable) -> str:
    rows, answered = len(table.q), int(table.ok.sum())
    if rows == 1:
        x, y, z = (f"{v:.6g}" for v in table.position[0])
        return f"The tool is at ({x}, {y}, {z}) m"
    if table.configuration.any():
        return f"{rows} solutions for {_poses(len(np.unique(table.pose)))}, {answered} within the joint limits"
    return f"{answered} of {rows} {'poses can be reached' if table.inverse else 'positions have a pose'}"


def _summary(table: PoseTable) -> str:
    mode = "all configurations" if table.configuration.any() else "home's configuration and assembly mode"
    return f"{_title(table)} of {table.robot.name}, {mode}; tool in the world frame."


def _poses(n: int) -> str:
    return "1 pose" if n == 1 else f"{n} poses"


def _heads(table: PoseTable) -> list[str]:
    kept = ["pose", *(["signs"] if table.configuration.any() else [])]
    joints = [f"{j} [{u}]" for j, u in zip(table.robot.actuated, table.robot.position_units, strict=True)]
    return [*kept, *joints, "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw", "why not"]


def _cells(table: PoseTable, k: int, digits: str = "{:.6f}") -> list[str]:
    kept = [str(table.pose[k]), *([table.configuration[k]] if table.configuration.any() else [])]
    numbers = [*table.q[k], *table.position[k], *table.quaternion[k]]
    return [*kept, *(_number(x, digits) for x in numbers), str(table.reason[k])]


def _number(x: float, digits: str = "{:.6f}") -> str:
    return digits.format(x) if np.isfinite(x) else ""
