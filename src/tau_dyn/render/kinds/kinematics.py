"""Positions and poses of `fk` and `ik`: one answer as a list, several as a table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from tau_dyn import results as r
from tau_dyn.kinematics import PoseTable
from tau_dyn.render.presentation import list_assumptions, present_kind, warn

_MAX_ROWS = 200  # rows of a table on a page
_MAX_PRINTED = 12  # rows of a table on a terminal
_KEPT = ("pose", "row", "signs", "mode")
"""Columns that identify a row."""


@present_kind.register
def present_poses(table: PoseTable) -> r.Presentation:
    """Return the presentation of positions and poses."""
    answered, rows = int(table.ok.sum()), len(table.q)
    every = "Answered" if rows == 1 else "All rows answered"
    badge = every if answered == rows else f"{answered} of {rows} answered"
    verdict = r.Verdict("good" if answered == rows else "care", "", badge)
    sections = [
        *warn([r.end_sentence(text) for text in table.warnings]),
        r.Chapter("poses", "Positions and poses", lambda: _build_poses(table), r.On.ALL),
        *list_assumptions(table.robot.assumed),
    ]
    return r.Presentation(
        f"{_title(table)} of", table.robot.name, f"{table.robot.name}: {_title(table).lower()}", f"{_headline(table)}.", verdict,
        _summary(table), sections, table.warnings, r.RobotPicture(table.robot), r.Provenance(robot=table.robot),
        table.columns, table,
    )  # fmt: skip


def _build_poses(table: PoseTable) -> Iterator[r.Element]:
    if len(table.q) == 1:
        columns = [
            r.Column(),
            r.Column("value", "number"),
            r.Column("", "unit"),
            r.Column("joint limits", on=r.On.PAGE),
        ]
        yield r.ResultTable(columns, [r.Row(row) for row in _list_single(table)], style="plain fitted", on=r.On.PRINTED)
    else:
        yield _build_table(table, r.On.PAGE)
        yield _build_table(table, r.On.TERMINAL)
        if len(table.q) > _MAX_ROWS:
            yield r.explain(f"{len(table.q) - _MAX_ROWS} rows more are in the table that --out writes.")
    yield r.explain(
        "The tool's place and orientation (quaternion) in the world. Joint limits are the robot file's. The drawing "
        "shows the robot at home."
    )
    frame = table.columns()
    rows = [
        r.Row([_tell(x) for x in row], "" if row[-1] == "" else "poor") for row in zip(*frame.values(), strict=True)
    ]
    yield r.ResultTable([r.Column(name) for name in frame], rows, on=r.On.NOTEBOOK)


def _tell(x: Any) -> str:
    return str(x) if isinstance(x, str) else r.format_number(float(x), 6) if np.isfinite(x) else ""


def _build_table(table: PoseTable, on: r.On) -> r.ResultTable:
    """Return the rows; columns that identify a row are repeated if a terminal splits the table."""
    heads = _heads(table)
    kept = [k for k, head in enumerate(heads) if head in _KEPT]
    shown = [
        *kept,
        *(_choose_printed(table, heads, kept) if on is r.On.TERMINAL else _choose_paged(table, heads, kept)),
    ]
    digits = "{:.4f}" if on is r.On.TERMINAL else "{:.5f}"
    rows = [_cells(table, k, digits) for k in range(min(len(table.q), _MAX_ROWS))]
    columns = [r.Column(heads[k], "text" if heads[k] == "why not" else "number", kept=k in kept) for k in shown]
    rest = "rows more; --out FILE.csv writes them all"
    return r.ResultTable(
        columns, [r.Row([row[k] for k in shown]) for row in rows], style="poses", most=_MAX_PRINTED, rest=rest, on=on
    )


def _choose_paged(table: PoseTable, heads: list[str], kept: list[int]) -> list[int]:
    """Return a page's columns, with reasons only if there are any."""
    why = heads.index("why not")
    return [*([] if table.ok.all() else [why]), *(k for k in range(len(heads)) if k not in (*kept, why))]


def _choose_printed(table: PoseTable, heads: list[str], kept: list[int]) -> list[int]:
    """Return a terminal's columns, the answer first."""
    joints = list(range(len(kept), len(kept) + table.robot.na))
    place = [k for k, head in enumerate(heads) if head in ("x [m]", "y [m]", "z [m]")]
    turns = [heads.index(f"q{axis}") for axis in "xyzw"]
    why = [] if table.ok.all() else [heads.index("why not")]
    if table.inverse:  # a pose that all rows share is in the headline
        return [*joints, *why, *([] if len(np.unique(table.pose)) == 1 else place)]
    one = len(table.counts) == 1  # its positions are known; orientations distinguish modes
    return [*place, *turns, *why] if one else [*place, *why, *joints]


def _list_single(table: PoseTable) -> list[tuple[str, str, str, str]]:
    """Return one answer as rows: name, value, unit, and the limits of a joint."""
    robot = table.robot
    rows = [
        (name, _number(x), unit, f"{low:.4g} to {high:.4g}")
        for name, x, unit, low, high in zip(
            robot.actuated, table.q[0], robot.position_units, robot.lower, robot.upper, strict=True
        )
    ]
    tool = [(f"tool {axis}", _number(x), "m", "") for axis, x in zip("xyz", table.position[0], strict=True)]
    tool += [(f"tool q{axis}", _number(x), "", "") for axis, x in zip("xyzw", table.quaternion[0], strict=True)]
    return [*rows, *tool] if table.inverse else [*tool, *rows]


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
        x, y, z = (f"{round(v, 9) + 0.0:.6g}" for v in table.position[0])
        return f"The tool {'gets to' if table.inverse else 'is at'} ({x}, {y}, {z}) m"
    if table.configuration.any():
        poses = len(table.counts)
        x, y, z = (f"{round(v, 9) + 0.0:.6g}" for v in table.position[0])
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
    text = digits.format(x) if np.isfinite(x) else ""
    return text.removeprefix("-") if text and float(text) == 0.0 else text  # no minus sign before a zero
