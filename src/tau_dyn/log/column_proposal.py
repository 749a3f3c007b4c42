"""A foreign log's columns and a robot's joints become a proposed column map, with a sentence for each doubt.

Names tell which columns may be positions, velocities, torques, references or currents (`column_groups.py`). Units that no name
says are told by magnitude: positions by the joints' limits, clocks by their step. A velocity has to be the derivative of the
position, whose slope also tells its unit. Currents are no torques: the torque constant is not in a log, and is not invented.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log.check import JointLimits
from tau_dyn.log.column_groups import (
    CLOCKS,
    ColumnGroup,
    choose_group,
    find_groups,
)
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import DEGREE, find_named_scale, format_names, is_contract_name, split_words
from tau_dyn.log.read import EPISODE, has_topics, read_any
from tau_dyn.log.table import Table
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

MIN_CORRELATION = 0.9
"""Of a position and its integrated velocity, both without their trend; sensors' noise leaves more, another signal less."""

MAX_SLOPE_ERROR = 0.1
"""How far the slope of position over integrated velocity may lie from a unit's size; the units lie wider apart."""

MAX_SECONDS_STEP = 0.5
"""Longest step [s] of a robot's log; a larger number counts smaller units."""

LIMIT_MARGIN = 0.05  # of a joint's range; encoders and stops differ by as much from a robot file


@dataclass(frozen=True)
class ColumnProposal:
    """A proposed column map.

    Attributes:
        log: The log's file name.
        sha256: Hash of the log's bytes.
        robot_joints: The robot's actuated joints.
        entries: The map, as YAML gives it.
        warnings: What is unsure, a sentence each.
    """

    log: str
    sha256: str
    robot_joints: tuple[str, ...]
    entries: Mapping[str, Any]
    warnings: tuple[str, ...]

    def to_map(self) -> ColumnMap:
        """Return the map, checked."""
        return ColumnMap.from_dict(self.entries)

    def to_yaml(self) -> str:
        """Return the text of a file that `--columns` reads, with the doubts as comments."""
        lines = [f"# Proposed for {_one_line(self.log)}; ours = scale * column."]
        lines += [f"# {_one_line(sentence)}" for sentence in self.warnings]
        return (
            "\n".join(lines + [f"{_quote(key)}: {_format_entry(value)}" for key, value in self.entries.items()]) + "\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON holds."""
        return {"log": self.log, "joints": list(self.robot_joints), "columns": dict(self.entries)}


def propose_columns(path: str | Path, robot: JointLimits) -> ColumnProposal:
    """Propose a column map for a log of a robot.

    Args:
        path: The log, in any format that `read_log` reads.
        robot: Its actuated joints with their kinds and limits.

    Raises:
        InputError: The log cannot be read.
        CannotAnswer: No column can be the joints' positions.
    """
    table = _read(Path(path))
    table, draft = _choose_episode(table)
    own = {f"cmd_{joint}" for joint in robot.actuated}  # which keep their name
    values = {c: x for c in table.cells if c not in own and (x := _find_numbers(table, c)) is not None}
    if has_topics(Path(path)) and "t" in values:  # a reader gives that clock with any map; a map names fields
        t = values["t"]
        fields = {c: x for c, x in values.items() if not is_contract_name(c)}
        values = fields if any("position" in split_words(c) for c in fields) else values
    else:
        t, clock = _propose_clock(table.name, values)
        draft += clock
    named = _list_named(draft.entries)
    if values and all(c.isdigit() for c in values):
        groups, guessed = _guess_numbered([c for c in values if c not in named], values, t, len(robot.actuated))
        draft += guessed
    else:
        groups = find_groups([c for c in values if c not in named], robot.actuated, Path(path).stem)
    q, positions = _propose_positions(table, groups, values, robot)
    draft += positions
    draft += _propose_velocities(groups, values, t, q, robot)
    draft += _propose_forces(groups, robot)
    draft += _propose_references(groups, q, robot)
    draft += _name_gaps(table, draft.entries, robot)
    return ColumnProposal(table.name, table.sha256, tuple(robot.actuated), draft.entries, tuple(draft.warnings))


@dataclass(frozen=True)
class _Draft:
    """Lines of a map, and what is unsure about them."""

    entries: Mapping[str, Any]
    warnings: Sequence[str]

    def __add__(self, other: _Draft) -> _Draft:
        """Return both."""
        return _Draft({**self.entries, **other.entries}, [*self.warnings, *other.warnings])


def _name_gaps(table: Table, entries: Mapping[str, Any], robot: JointLimits) -> _Draft:
    """Return what is to be said of joints that lack a position or torque which others have, with the columns that are left.

    A column with the right name is kept, whatever its cells hold.
    """
    used, kept, warnings = _list_named(entries), {}, []
    wanted = {signal: [f"{signal}_{joint}" for joint in robot.actuated] for signal in ("q", "tau")}
    missing = {s: [c for c in named if c not in entries] for s, named in wanted.items()}
    missing = {s: gaps for s, gaps in missing.items() if len(gaps) < len(wanted[s])}
    for column in (c for gaps in missing.values() for c in gaps if c in table.cells):
        kept[column] = column
        warnings.append(CodedWarning("column_unsure", f"Some cells of {column} are not finite numbers."))
    left = [column for column in table.cells if column not in used and column not in kept]
    for signal, gaps in missing.items():
        if lost := [column for column in gaps if column not in kept]:
            joints = format_names(column.removeprefix(f"{signal}_") for column in lost)
            sentence = (
                f"No column can be the {_WORDS[signal]} of {joints}; not mapped: {format_names(left)}. Add `{lost[0]}: COLUMN` "
                "to the map, or log it."
            )
            warnings.append(CodedWarning("column_missing", sentence))
    return _Draft(kept, warnings)


_WORDS = {"q": "position", "tau": "torque"}


def _pair(chosen: ColumnGroup | None, joints: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the column of each joint that a group has, and a doubt about each column of other words."""
    if chosen is None:
        return {}, []
    found = {joint: column for joint, column in zip(joints, chosen.columns, strict=True) if column}
    taken = [(joint, column) for joint, column in found.items() if column in chosen.filled]
    sentences = [f"{column} is taken for {chosen.kind}_{joint} by its name alone." for joint, column in taken]
    return found, [CodedWarning("column_unsure", sentence) for sentence in sentences]


def _read(path: Path) -> Table:
    """Read all columns, as a map's reader does."""
    return read_any(path) if has_topics(path) else read_any(path, {})


def _find_numbers(table: Table, column: str) -> NDArray[np.float64] | None:
    """Return a column (N,) of finite numbers, or None."""
    if table.cells[column].dtype.kind == "b":
        return None
    values = table.numbers_or_none(column)
    return values if values is not None and values.size and np.all(np.isfinite(values)) else None


def _choose_episode(table: Table) -> tuple[Table, _Draft]:
    """Return the first episode's rows, and the line that chooses it; all rows of a log without episodes."""
    if EPISODE not in table.cells:
        return table, _Draft({}, [])
    numbers = table.numbers(EPISODE)
    first, n_episodes = int(numbers[0]), np.unique(numbers).size
    sentence = f"{table.name} holds {n_episodes} episodes, which are logs of their own; the map takes episode {first}."
    warnings = [CodedWarning("column_unsure", sentence)] if n_episodes > 1 else []
    return table.take_rows(np.flatnonzero(numbers == numbers[0])), _Draft({"episode": first}, warnings)


def _list_named(entries: Mapping[str, Any]) -> set[str]:
    """Return the foreign columns that entries name."""
    return {value["column"] if isinstance(value, dict) else str(value) for value in entries.values()}


def _propose_clock(name: str, values: Mapping[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64] | None, _Draft]:
    """Return the times (N,) [s], None where there is no clock, and the clock's line."""
    rising = [c for c, x in values.items() if x.size > 1 and np.all(np.diff(x) > 0)]
    named = [c for c in values if CLOCKS & set(split_words(c)[:1] + split_words(c)[-2:])]
    column = next((c for c in named if c in rising), None)
    warnings: list[str] = []
    if column is None and named:
        sentence = f"{named[0]} is not taken for the clock: it does not rise from row to row."
        warnings.append(CodedWarning("column_unsure", sentence))
    if column is None and "1" in rising and "2" in values:
        column = "1"
        warnings.append(CodedWarning("column_unsure", f"{name}: column 1 rises throughout and is taken for the clock."))
    if column is None:
        sentence = f"{name} has no clock; add `t: {{rate_hz: F}}` with the rate of the recording [Hz]."
        return None, _Draft({}, [*warnings, CodedWarning("column_missing", sentence)])
    step = float(np.median(np.diff(values[column])))
    scale = find_named_scale(column, "t")
    if scale is None:
        scale = next(s for s in (1.0, 1e-3, 1e-6, 1e-9) if step * s <= MAX_SECONDS_STEP or s == 1e-9)
        if scale != 1.0:
            sentence = f"{column} steps by {step:.6g}, taken for {_TIME_UNITS[scale]}: {1 / (step * scale):.6g} Hz."
            warnings.append(CodedWarning("unit_unsure", sentence))
    return scale * (values[column] - values[column][0]), _Draft({"t": _build_entry(column, scale)}, warnings)


_TIME_UNITS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}


def _guess_numbered(
    columns: Sequence[str], values: Mapping[str, NDArray[np.float64]], t: NDArray[np.float64] | None, n: int
) -> tuple[list[ColumnGroup], _Draft]:
    """Return the groups of a file without a header: blocks of n columns, a joint each, where something tells them apart."""
    blocks = [tuple(columns[k : k + n]) for k in range(0, len(columns) - n + 1, n)]
    pairs = [(a, b) for a in blocks for b in blocks if a != b]
    moving = next((p for p in pairs if t is not None and _match_slope(p, values, t) is not None), None)
    if moving is None and len(columns) != n:
        return [], _Draft({}, [])
    chosen = moving or (blocks[0],)
    why = f"{moving[1][0]} to {moving[1][-1]} are their derivative" if moving else "there is nothing else"
    sentence = f"There is no header: columns {chosen[0][0]} to {chosen[0][-1]} are taken for positions, as {why}."
    warnings = [CodedWarning("column_unsure", sentence)]
    if rest := [c for c in columns if not any(c in block for block in chosen)]:
        sentence = f"Columns {format_names(rest)} are not mapped: nothing says what they are."
        warnings.append(CodedWarning("column_unsure", sentence))
    groups = [ColumnGroup(kind, (), block, False) for kind, block in zip(("q", "v"), chosen, strict=False)]
    return groups, _Draft({}, warnings)


def _match_slope(
    pair: tuple[tuple[str, ...], tuple[str, ...]], values: Mapping[str, NDArray[np.float64]], t: NDArray[np.float64]
) -> float | None:
    """Return the slope of positions over integrated velocities, of joints that move; None where they do not go together."""
    slopes = []
    for position, velocity in zip(*pair, strict=True):
        q, v = values[position], values[velocity]
        if np.ptp(q) == 0.0 or np.ptp(v) == 0.0:
            continue
        path = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
        q, path = _detrend(t, q), _detrend(t, path)
        size = float(np.linalg.norm(q) * np.linalg.norm(path))
        if size == 0.0 or not np.isfinite(size) or q @ path < MIN_CORRELATION * size:
            return None
        slopes.append(float(q @ path / (path @ path)))
    return float(np.median(slopes)) if slopes else None


def _detrend(t: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return samples (N,) without their mean and slope over time."""
    centred = t - t.mean()
    x = x - x.mean()
    return x - centred * float(centred @ x) / max(float(centred @ centred), np.finfo(float).tiny)


class _Positions(NamedTuple):
    """Chosen positions: their columns by joint, and what brings each one to SI units."""

    columns: Mapping[str, str]
    scales: Mapping[str, float]


def _propose_positions(
    table: Table, groups: Sequence[ColumnGroup], values: Mapping[str, NDArray[np.float64]], robot: JointLimits
) -> tuple[_Positions, _Draft]:
    """Return the positions, and their lines."""
    joints = tuple(robot.actuated)
    chosen, warnings = choose_group(groups, "q")
    if chosen is None:
        raise CannotAnswer(
            "positions_missing",
            f"{table.name} has no columns that can be the positions of {format_names(joints)}; it has "
            f"{format_names(table.cells)}",
            f"name a position for {count(len(joints), 'joint')} in a column map, as `q_{joints[0]}: COLUMN`, or log them",
        )
    if not chosen.by_name and len(joints) > 1:
        more = f"; {chosen.more} more are left out." if chosen.more else "."
        sentence = (
            f"{chosen.columns[0]} to {chosen.columns[-1]} carry numbers, not names, and are taken for "
            f"{format_names(joints)} in this order{more}"
        )
        warnings.append(CodedWarning("column_unsure", sentence))
    columns, taken = _pair(chosen, joints)
    scales, doubts = _find_position_scales(columns, values, robot)
    entries = {f"q_{j}": _build_entry(column, scales[j]) for j, column in columns.items()}
    return _Positions(columns, scales), _Draft(entries, [*warnings, *taken, *doubts])


def _find_position_scales(
    columns: Mapping[str, str], values: Mapping[str, NDArray[np.float64]], robot: JointLimits
) -> tuple[dict[str, float], list[str]]:
    """Return what brings each joint's positions to m or rad, and doubts; joints of a kind share a unit."""
    scales, warnings = dict.fromkeys(columns, 1.0), []
    pairs = list(zip(robot.actuated, robot.joint_kinds, strict=True))
    for kind, small, unit in (("revolute", DEGREE, "degrees"), ("prismatic", 1e-3, "mm")):
        mine = {k: columns[joint] for k, (joint, own) in enumerate(pairs) if own == kind and joint in columns}
        if not mine:
            continue
        named = find_named_scale(next(iter(mine.values())), "q")
        if named is not None:
            scales |= {robot.actuated[k]: named for k in mine}
            continue
        outside = [k for k, column in mine.items() if not _is_within(values[column], robot, k)]
        if not outside:
            continue
        column, joint = mine[outside[0]], robot.actuated[outside[0]]
        if all(_is_within(values[column] * small, robot, k) for k, column in mine.items()):
            scales |= {robot.actuated[k]: small for k in mine}
            sentence = (
                f"{column} leaves the limits of {joint} in SI units and not in {unit}, and is taken for {unit}; a gear "
                "ratio looks alike."
            )
        else:
            sentence = (
                f"{column} leaves the limits of {joint} in SI units and in {unit}: another unit, zero, gear ratio or joint; "
                "give scale and offset by hand."
            )
        warnings.append(CodedWarning("unit_unsure", sentence))
    return scales, warnings


def _is_within(q: NDArray[np.float64], robot: JointLimits, k: int) -> bool:
    """Tell whether positions lie within a joint's limits; without limits, within two turns or 10 m."""
    low, high = float(robot.lower[k]), float(robot.upper[k])
    if not np.isfinite(high - low):
        bound = 4 * np.pi if robot.joint_kinds[k] == "revolute" else 10.0
        return bool(np.all(np.abs(q) <= bound))
    margin = LIMIT_MARGIN * (high - low)
    return bool(np.all((q >= low - margin) & (q <= high + margin)))


def _propose_velocities(
    groups: Sequence[ColumnGroup],
    values: Mapping[str, NDArray[np.float64]],
    t: NDArray[np.float64] | None,
    q: _Positions,
    robot: JointLimits,
) -> _Draft:
    """Return lines of the velocities that are the positions' derivative."""
    chosen, warnings = choose_group(groups, "v")
    entries: dict[str, Any] = {}
    for joint, column in _pair(chosen, robot.actuated)[0].items():
        if joint not in q.columns:
            continue
        position, named = q.columns[joint], find_named_scale(column, "v")
        if np.ptp(values[position]) == 0.0 or np.ptp(values[column]) == 0.0:  # at rest
            entries[f"v_{joint}"] = _build_entry(column, q.scales[joint] if named is None else named)
            continue
        slope = None if t is None else _match_slope(((position,), (column,)), values, t)
        if slope is None:
            why = "without a clock nobody can tell whether it is" if t is None else "it is not"
            sentence = f"{column} is not mapped: {why} the derivative of {position}."
            warnings.append(CodedWarning("column_unsure", sentence))
            continue
        slope *= q.scales[joint]
        scale = _round_scale(slope, 1.0 if named is None else named)
        if scale is None:
            sentence = (
                f"{column} is not mapped: times {slope:.4g} it is the derivative of {position}, and no unit is so."
            )
            warnings.append(CodedWarning("unit_unsure", sentence))
            continue
        entries[f"v_{joint}"] = _build_entry(column, scale)
    return _Draft(entries, warnings)


def _round_scale(slope: float, likely: float) -> float | None:
    """Return the unit's size that a slope means, the likely one first; None where none is near."""
    sizes = (likely, 1.0, DEGREE, np.pi / 30, 1e-3)
    return next((s for s in sizes if abs(slope / s - 1) <= MAX_SLOPE_ERROR), None)


def _propose_forces(groups: Sequence[ColumnGroup], robot: JointLimits) -> _Draft:
    """Return lines of measured torques, or what currents and controllers' torques lack."""
    joints = tuple(robot.actuated)
    chosen, warnings = choose_group(groups, "tau")
    if chosen is not None:
        columns, taken = _pair(chosen, joints)
        scales = {joint: find_named_scale(column, "tau") for joint, column in columns.items()}
        first = next(iter(columns))
        if columns[first] != f"tau_{first}":
            unit = "" if scales[first] else " in N m (N of a sliding joint)"
            sentence = (
                f"{columns[first]} is taken for the torque behind the gear{unit}; one at the motor takes the gear ratio as "
                "its scale."
            )
            warnings.append(CodedWarning("unit_unsure", sentence))
        entries = {f"tau_{j}": _build_entry(c, scales[j] or 1.0) for j, c in columns.items()}
        return _Draft(entries, [*warnings, *taken])
    current, doubts = choose_group(groups, "current")
    asked, _ = choose_group(groups, "tau_ref")
    if current is not None:
        sentence = (
            f"{current.columns[0]} is a current, not a torque; give the torque constant behind the gear [N m/A] as "
            f"`tau_{joints[0]}: {{column: {current.columns[0]}, scale: CONSTANT}}`."
        )
        doubts.append(CodedWarning("torque_constant_missing", sentence))
    if asked is not None:
        sentence = f"{asked.columns[0]} is what the controller asks for, not a measurement, and is not mapped."
        doubts.append(CodedWarning("column_unsure", sentence))
    if current is None and asked is None:
        sentence = "No column is a torque; without one `identify` needs the controller."
        doubts.append(CodedWarning("column_missing", sentence))
    return _Draft({}, doubts)


def _propose_references(groups: Sequence[ColumnGroup], q: _Positions, robot: JointLimits) -> _Draft:
    """Return lines of the positions that were asked for, in the unit of the positions unless their names say another."""
    chosen, warnings = choose_group(groups, "q_ref")
    columns, taken = _pair(chosen, robot.actuated)
    entries = {}
    for joint, column in columns.items():
        named = find_named_scale(column, "q")
        entries[f"q_ref_{joint}"] = _build_entry(column, q.scales.get(joint, 1.0) if named is None else named)
    return _Draft(entries, [*warnings, *taken])


def _build_entry(column: str, scale: float) -> Any:
    name = int(column) if re.fullmatch(r"[1-9]\d{0,8}", column, re.ASCII) else column
    return name if scale == 1.0 else {"column": name, "scale": scale}


def _format_entry(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_format_entry(part)}" for key, part in value.items()) + "}"
    return _quote(value) if isinstance(value, str) else repr(value)


def _quote(text: str) -> str:
    """Return text as YAML reads it back; quoted unless it is a plain word."""
    plain = re.fullmatch(r"[A-Za-z_][\w.]*", text, re.ASCII) and text.lower() not in _YAML_WORDS
    return text if plain else yaml.safe_dump(text, default_style='"', width=float("inf")).strip()


_YAML_WORDS = frozenset("y n yes no on off true false null".split())


def _one_line(sentence: str) -> str:
    return "".join(c if c.isprintable() else " " for c in sentence)
