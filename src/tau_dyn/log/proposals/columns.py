"""Propose a column map from a foreign log's columns and a robot's joints, with a sentence for each doubt.

Names indicate which columns may be positions, velocities, torques, references or currents (`column_groups.py`). Units that are
not in a name follow from magnitude: positions from the joints' limits, clocks from their step. A velocity has to be the
derivative of the position; the slope between them also gives the position's unit. Currents are no torques: the torque constant is
not in a log, and is not invented. The map is read back before it is proposed. If no column is a position, a template lists the
numeric columns.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log.check import JointLimits, list_unit_warnings
from tau_dyn.log.clocks import (
    SECONDS_A_DAY,
    Clock,
    describe_coarse_text,
    find_day_numbers,
    find_split_clock,
    measure_coarse_rate,
    read_text_clock,
)
from tau_dyn.log.column_groups import (
    CLOCKS,
    ColumnGroup,
    choose_group,
    find_groups,
)
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import DEGREE, find_named_scale, format_names, is_contract_name, split_words
from tau_dyn.log.read import EPISODE, has_topics, read_any, read_log, refuse_signals_in_rows
from tau_dyn.log.table import Table
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

MIN_CORRELATION = 0.9
"""Correlation of a position and its integrated velocity, both without trend; sensor noise leaves more, another signal less."""

MAX_SLOPE_ERROR = 0.1
"""Largest relative deviation of the slope of position over integrated velocity from a unit's size; units differ by more."""

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
        warnings: One sentence for each doubt.
        template: Lines to complete by hand if no column is a position; empty otherwise.
    """

    log: str
    sha256: str
    robot_joints: tuple[str, ...]
    entries: Mapping[str, Any]
    warnings: tuple[str, ...]
    template: tuple[str, ...] = ()

    def to_map(self) -> ColumnMap:
        """Return the map, checked."""
        return ColumnMap.from_dict(self.entries)

    def to_yaml(self) -> str:
        """Return the text of a file that `--columns` reads, with the doubts as comments."""
        lines = [f"# Proposed for {_one_line(self.log)}; ours = scale * column."]
        lines += [f"# {_one_line(sentence)}" for sentence in self.warnings]
        lines += [f"{_quote(key)}: {_format_entry(value)}" for key, value in self.entries.items()]
        return "\n".join([*lines, *self.template]) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        more = {"template": list(self.template)} if self.template else {}
        return {"log": self.log, "joints": list(self.robot_joints), "columns": dict(self.entries), **more}


def propose_log_columns(path: str | Path, robot: JointLimits, *, is_part: bool = False) -> ColumnProposal:
    """Propose a column map for a log of a robot.

    Args:
        path: The log, in any format that `read_log` reads.
        robot: Its actuated joints with their kinds and limits.
        is_part: Whether other files of the recording may hold the positions or torques; their lack is no doubt then.

    Raises:
        InputError: The log cannot be read.
        CannotAnswer: No column except the clock holds numbers.
    """
    table = read_columns(Path(path))
    table, draft = _choose_episode(table)
    own = {f"cmd_{joint}" for joint in robot.actuated}  # which keep their name
    values = {c: x for c in table.cells if c not in own and (x := _find_numbers(table, c)) is not None}
    if has_topics(Path(path)) and "t" in values:  # a reader gives that clock with any map; a map names fields
        t = values["t"]
        fields = {c: x for c, x in values.items() if not is_contract_name(c)}
        values = fields if any("position" in split_words(c) for c in fields) else values
    else:
        t, clock = _propose_clock(table, values)
        draft += clock
    recorded = _Recorded(values, table.units, t)
    named = _list_named(draft.entries)
    if values and all(c.isdigit() for c in values):
        groups, guessed = _guess_numbered([c for c in values if c not in named], values, t, len(robot.actuated))
        draft += guessed
    else:
        groups = find_groups([c for c in values if c not in named], robot.actuated, Path(path).stem)
    q, positions = _propose_positions(table, groups, recorded, robot)
    draft += positions if q.columns or not is_part else _Draft({}, [])
    draft += _propose_velocities(groups, recorded, q, robot)
    forces = _propose_forces(groups, recorded, robot)
    draft += forces if forces.entries or not is_part else _Draft({}, [])
    has_forces = is_part or bool(forces.entries) or any(group.kind == "current" for group in groups)
    draft += _propose_references(groups, recorded, q, robot, "q_ref" if has_forces else "cmd")
    template = () if q.columns or is_part else _write_template(table, recorded, draft.entries, robot)
    if q.columns and not is_part:
        draft += _name_gaps(table, draft.entries, robot)
        if t is not None:  # else the missing clock is listed already
            draft += _read_back(Path(path), draft.entries, robot)
    warnings = tuple(dict.fromkeys(draft.warnings))
    return ColumnProposal(table.name, table.sha256, tuple(robot.actuated), draft.entries, warnings, template)


class _Recorded(NamedTuple):
    """A log's columns of numbers (N,), the units that a row below the header gives, and its times (N,) [s], or None."""

    values: Mapping[str, NDArray[np.float64]]
    units: Mapping[str, str]
    t: NDArray[np.float64] | None

    def find_scale(self, column: str, kind: str) -> float | None:
        """Return the size in SI of the unit that a column's name or its unit gives; None without one."""
        unit = self.units.get(column, "").partition("/")[0]
        return find_named_scale(f"{column} {unit}".replace("°", "deg"), kind)


def _read_back(path: Path, entries: Mapping[str, Any], robot: JointLimits) -> _Draft:
    """Read the log by the proposed map, and return a doubt about each line that does not give a sound column."""
    try:
        log = read_log(path, ColumnMap.from_dict(entries))
    except InputError as fault:
        sentence = f"The map is not complete; read by it, the log is refused: {fault}"
        return _Draft({}, [CodedWarning("column_unsure", sentence)])
    scaled = {key for key, value in entries.items() if isinstance(value, dict)}  # whose doubts are listed already
    plain = replace(log, channels={key: x for key, x in log.channels.items() if key not in scaled})
    return _Draft({}, [CodedWarning("unit_unsure", sentence) for sentence in list_unit_warnings(plain, robot)])


MAX_TEMPLATE_COLUMNS = 60
"""Largest number of columns in a template."""


def _write_template(
    table: Table, recorded: _Recorded, entries: Mapping[str, Any], robot: JointLimits
) -> tuple[str, ...]:
    """Return the lines of a map that a person has to complete, and the numeric columns with their ranges.

    Raises:
        InputError: Each row holds the name of a signal.
        CannotAnswer: There is no column of numbers except the clock.
    """
    refuse_signals_in_rows(table)
    values = recorded.values
    free = [column for column in values if column not in _list_named(entries)]
    if not free:
        joints = robot.actuated
        raise CannotAnswer(
            "positions_missing",
            f"{table.name} has no columns that can be the positions of {format_names(joints)}; it has "
            f"{format_names(table.cells)}",
            f"name a position for {count(len(joints), 'joint')} in a column map, as `q_{joints[0]}: COLUMN`, or log them",
        )
    wanted = [f"{signal}_{joint}" for signal in ("q", "tau") for joint in robot.actuated]
    lines = [f"# {ours}: {{column: COLUMN, scale: 1.0}}" for ours in wanted if ours not in entries]
    scales = {
        c: next((x for kind in ("q", "tau") if (x := recorded.find_scale(c, kind)) not in (None, 1.0)), 1.0)
        for c in free
    }
    units = {c: f"; scale: {scale:.9g} by its unit" for c, scale in scales.items() if scale != 1.0}
    ranges = [f"{c} ({values[c].min():.4g} to {values[c].max():.4g}{units.get(c, '')})" for c in free]
    more = [f"{len(free) - MAX_TEMPLATE_COLUMNS} more"] if len(free) > MAX_TEMPLATE_COLUMNS else []
    return (
        "# Complete a line for each joint and remove its # (rad, m, N m, N).",
        *lines,
        f"# Columns of numbers in {_one_line(table.name)}:",
        *(f"#   {_one_line(text)}" for text in [*ranges[:MAX_TEMPLATE_COLUMNS], *more]),
    )


@dataclass(frozen=True)
class _Draft:
    """Lines of a map, and doubts about them."""

    entries: Mapping[str, Any]
    warnings: Sequence[str]

    def __add__(self, other: _Draft) -> _Draft:
        """Return both."""
        return _Draft({**self.entries, **other.entries}, [*self.warnings, *other.warnings])


def _name_gaps(table: Table, entries: Mapping[str, Any], robot: JointLimits) -> _Draft:
    """Return warnings about joints that lack a position or torque which others have, with the remaining columns.

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


def read_columns(path: Path) -> Table:
    """Read all columns, as a map's reader does."""
    return read_any(path) if has_topics(path) else read_any(path, {})


def _find_numbers(table: Table, column: str) -> NDArray[np.float64] | None:
    """Return a column (N,) of numbers, with its gaps interpolated for the tests; None for text or without numbers."""
    if table.cells[column].dtype.kind == "b":
        return None
    values = table.numbers_or_none(column)
    if values is None or not values.size or np.isinf(values).any() or np.isnan(values).all():
        return None
    gaps = np.isnan(values)
    if gaps.any():
        rows = np.arange(values.size)
        values = np.interp(rows, rows[~gaps], values[~gaps])
    return values


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
    return {value.get("column", "") if isinstance(value, dict) else str(value) for value in entries.values()}


def _propose_clock(
    table: Table, values: Mapping[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64] | None, _Draft]:
    """Return the times (N,) [s], None if there is no clock, and the clock's line."""
    recorded, name = _Recorded(values, table.units, None), table.name
    if (split := find_split_clock(tuple(values))) is not None:
        times = values[split[0]] - values[split[0]][0] + 1e-9 * values[split[1]]
        if np.all(np.diff(times) > 0):
            return times, _Draft({"t": _build_entry(split[0], 1.0)}, [])
    rising = [c for c, x in values.items() if x.size > 1 and np.all(np.diff(x) > 0)]
    named = [c for c in values if CLOCKS & set(split_words(c)[:1] + split_words(c)[-2:])]
    column = next((c for c in named if c in rising), None)
    texts = {
        c: clock for c in table.cells if c not in values and (clock := read_text_clock(table.cells[c])) is not None
    }
    if column is None and texts:
        return _propose_text_clock(table, texts)
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
    times = values[column]
    step = float(np.median(np.diff(times)))
    scale = recorded.find_scale(column, "t")
    if scale is None and find_day_numbers(times):
        sentence = f"{column} counts days, as spreadsheets do: {1 / (step * SECONDS_A_DAY):.6g} Hz."
        draft = _Draft({"t": _build_entry(column, 1.0)}, [*warnings, CodedWarning("unit_unsure", sentence)])
        return SECONDS_A_DAY * (times - times[0]), draft
    if scale is None:
        scale = _find_clock_scale(float(times[0]), step)
        if scale != 1.0:
            sentence = f"{column} steps by {step:.6g}, taken for {_TIME_UNITS[scale]}: {1 / (step * scale):.6g} Hz."
            warnings.append(CodedWarning("unit_unsure", sentence))
    return scale * (times - times[0]), _Draft({"t": _build_entry(column, scale)}, warnings)


def _propose_text_clock(table: Table, texts: Mapping[str, Clock]) -> tuple[NDArray[np.float64] | None, _Draft]:
    """Return the times (N,) [s] of a clock of dates or times of day, or None, and its line."""
    for column, clock in texts.items():
        known = clock.t[np.isfinite(clock.t)]
        if np.all(np.diff(known) > 0) and not describe_coarse_text(table.cells[column]):
            rows = np.arange(clock.t.size)
            t = np.interp(rows, rows[np.isfinite(clock.t)], known)
            return t, _Draft({"t": _build_entry(column, 1.0)}, [])
    column = next(iter(texts))
    rate = measure_coarse_rate(table.cells[column])
    if rate is None:
        sentence = f"{column} is not taken for the clock: it does not rise from row to row."
        return None, _Draft({}, [CodedWarning("column_unsure", sentence)])
    sentence = f"{column} has whole seconds only; the rate is counted, about {rate:.4g} samples a second."
    draft = _Draft({"t": {"rate_hz": float(f"{rate:.4g}")}}, [CodedWarning("column_unsure", sentence)])
    return np.arange(table.n_rows) / rate, draft


_EPOCH_S = (9e8, 4.1e9)
"""Seconds from 1970 of the years 1998 to 2099: by its size, an epoch clock's unit is known."""


def _find_clock_scale(first: float, step: float) -> float:
    """Return the size of a clock's unit [s], by its magnitude if it counts from 1970, else by its step."""
    sizes = (1.0, 1e-3, 1e-6, 1e-9)
    dated = (s for s in sizes if _EPOCH_S[0] <= first * s <= _EPOCH_S[1] and step * s <= MAX_SECONDS_STEP)
    stepped = (s for s in sizes if step * s <= MAX_SECONDS_STEP or s == 1e-9)
    return next(dated, None) or next(stepped)


_TIME_UNITS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}


def _guess_numbered(
    columns: Sequence[str], values: Mapping[str, NDArray[np.float64]], t: NDArray[np.float64] | None, n: int
) -> tuple[list[ColumnGroup], _Draft]:
    """Return the groups of a file without a header: blocks of n columns, one for each joint, if they can be identified."""
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
        sentence = f"Columns {format_names(rest)} are not mapped: their meaning is unknown."
        warnings.append(CodedWarning("column_unsure", sentence))
    groups = [ColumnGroup(kind, (), block, False) for kind, block in zip(("q", "v"), chosen, strict=False)]
    return groups, _Draft({}, warnings)


def _match_slope(
    pair: tuple[tuple[str, ...], tuple[str, ...]], values: Mapping[str, NDArray[np.float64]], t: NDArray[np.float64]
) -> float | None:
    """Return the slope of positions over integrated velocities, for joints that move; None if they do not match."""
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
    """Chosen positions: their columns and their scales to SI units, by joint."""

    columns: Mapping[str, str]
    scales: Mapping[str, float]


def _propose_positions(
    table: Table, groups: Sequence[ColumnGroup], recorded: _Recorded, robot: JointLimits
) -> tuple[_Positions, _Draft]:
    """Return the positions, and their lines; both empty if no column can be a position."""
    joints = tuple(robot.actuated)
    chosen, warnings = choose_group(groups, "q")
    if chosen is None:
        sentence = (
            f"{table.name} has no columns that can be the positions of {format_names(joints)} by their names; complete the "
            "lines of the template by hand."
        )
        return _Positions({}, {}), _Draft({}, [CodedWarning("column_missing", sentence)])
    if chosen.bare:
        sentence = f"{format_names(chosen.columns)} have the joints' names alone and are taken for positions."
        warnings = [*warnings, CodedWarning("column_unsure", sentence)]
    if not chosen.by_name and len(joints) > 1:
        more = f"; {chosen.more} more are left out." if chosen.more else "."
        sentence = (
            f"{chosen.columns[0]} to {chosen.columns[-1]} carry numbers, not names, and are taken for "
            f"{format_names(joints)} in this order{more}"
        )
        warnings.append(CodedWarning("column_unsure", sentence))
    columns, taken = _pair(chosen, joints)
    velocities = _pair(choose_group(groups, "v")[0], joints)[0]
    scales, doubts = _find_position_scales(columns, velocities, recorded, robot)
    entries = {f"q_{j}": _build_entry(column, scales[j]) for j, column in columns.items()}
    return _Positions(columns, scales), _Draft(entries, [*warnings, *taken, *doubts])


def _find_position_scales(
    columns: Mapping[str, str], velocities: Mapping[str, str], recorded: _Recorded, robot: JointLimits
) -> tuple[dict[str, float], list[str]]:
    """Return the scale of each joint's positions to m or rad, and doubts.

    Each joint is judged by its own name, velocity and limits. A joint that hardly moves fits both units; it takes the unit of
    most joints of its kind.
    """
    scales, warnings = dict.fromkeys(columns, 1.0), []
    pairs = list(zip(robot.actuated, robot.joint_kinds, strict=True))
    for kind, small, units in (("revolute", DEGREE, ("rad", "degrees")), ("prismatic", 1e-3, ("m", "mm"))):
        mine = {k: columns[joint] for k, (joint, own) in enumerate(pairs) if own == kind and joint in columns}
        judged = {k: _judge_unit(k, column, velocities, recorded, robot) for k, column in mine.items()}
        shown = [scale for scale, _ in judged.values() if scale is not None]
        usual = small if 2 * shown.count(small) > len(shown) else 1.0
        for k, (scale, doubt) in judged.items():
            if scale is None and small in shown:
                unit = units[usual == small]
                doubt = f"{mine[k]} fits {units[0]} and {units[1]}, and is taken for {unit}, as most joints of its kind are."
            scales[robot.actuated[k]] = usual if scale is None else scale
            warnings += [CodedWarning("unit_unsure", doubt)] if doubt else []
    return scales, warnings


MANY_TURNS = 4 * np.pi
"""Travel [rad] of a joint without limits from which its unit is doubted: two turns, or 13 degrees of another unit."""

MIN_TRAVEL_SHARE = 0.1
"""Travel in m or rad, as a share of a joint's range, that shows SI units: in mm or degrees it is below 0.2 % of the range."""


def _judge_unit(
    k: int, column: str, velocities: Mapping[str, str], recorded: _Recorded, robot: JointLimits
) -> tuple[float | None, str]:
    """Return the scale of a joint's position to m or rad, or None if its own data do not show it, and a doubt or ''."""
    joint, q = robot.actuated[k], recorded.values[column]
    small, unit = (DEGREE, "degrees") if robot.joint_kinds[k] == "revolute" else (1e-3, "mm")
    if (named := recorded.find_scale(column, "q")) is not None:
        return named, ""
    v = velocities.get(joint)
    slope = None if v is None or recorded.t is None else _match_slope(((column,), (v,)), recorded.values, recorded.t)
    if slope is not None and abs(slope * small - 1) <= MAX_SLOPE_ERROR:
        return small, f"{column} is {slope:.4g} times the integral of {v}, and is taken for {unit}."
    width = float(robot.upper[k] - robot.lower[k])
    if not np.isfinite(width) and robot.joint_kinds[k] == "revolute":
        doubted = slope is None and np.ptp(q) > MANY_TURNS
        doubt = f"{column} is taken for rad; {joint} has no limits, and no velocity shows the unit."
        return None if slope is None else 1.0, doubt if doubted else ""
    if _is_within(q, robot, k):
        return 1.0 if np.ptp(q) >= MIN_TRAVEL_SHARE * width else None, ""
    if _is_within(q * small, robot, k):
        sentence = f"{column} leaves the limits of {joint} in SI units and not in {unit}, and is taken for {unit}"
        return small, f"{sentence}; a gear ratio looks alike."
    sentence = (
        f"{column} leaves the limits of {joint} in SI units and in {unit}: another unit, zero, gear ratio or joint"
    )
    return 1.0, f"{sentence}; give scale and offset by hand."


def _is_within(q: NDArray[np.float64], robot: JointLimits, k: int) -> bool:
    """Return whether positions are within a joint's limits; without limits, within 10 m, or any number of turns."""
    low, high = float(robot.lower[k]), float(robot.upper[k])
    if not np.isfinite(high - low):
        return robot.joint_kinds[k] == "revolute" or bool(np.all(np.abs(q) <= 10.0))
    margin = LIMIT_MARGIN * (high - low)
    return bool(np.all((q >= low - margin) & (q <= high + margin)))


def _propose_velocities(
    groups: Sequence[ColumnGroup], recorded: _Recorded, q: _Positions, robot: JointLimits
) -> _Draft:
    """Return lines of the velocities that are the positions' derivative."""
    values, t = recorded.values, recorded.t
    chosen, warnings = choose_group(groups, "v")
    entries: dict[str, Any] = {}
    for joint, column in _pair(chosen, robot.actuated)[0].items():
        if joint not in q.columns:
            continue
        position, named = q.columns[joint], recorded.find_scale(column, "v")
        if np.ptp(values[position]) == 0.0 or np.ptp(values[column]) == 0.0:  # at rest
            entries[f"v_{joint}"] = _build_entry(column, q.scales[joint] if named is None else named)
            continue
        slope = None if t is None else _match_slope(((position,), (column,)), values, t)
        if slope is None:
            why = "without a clock it is unknown whether it is" if t is None else "it is not"
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
    """Return the unit size nearest a slope, the likely one first; None if no size is near."""
    sizes = (likely, 1.0, DEGREE, np.pi / 30, 1e-3)
    return next((s for s in sizes if abs(slope / s - 1) <= MAX_SLOPE_ERROR), None)


def _propose_forces(groups: Sequence[ColumnGroup], recorded: _Recorded, robot: JointLimits) -> _Draft:
    """Return lines of measured torques, or doubts about currents and controllers' torques."""
    joints = tuple(robot.actuated)
    chosen, warnings = choose_group(groups, "tau")
    if chosen is not None:
        columns, taken = _pair(chosen, joints)
        scales = {joint: recorded.find_scale(column, "tau") for joint, column in columns.items()}
        first = next(iter(columns))
        if columns[first] != f"tau_{first}":
            unit = "" if scales[first] else " in N m (N of a sliding joint)"
            sentence = (
                f"{columns[first]} is taken for the torque behind the gear{unit}; one at the motor takes the gear ratio as "
                "its scale, a current [A] the torque constant behind the gear [N m/A]."
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
        sentence = f"{asked.columns[0]} is the controller's reference, not a measurement, and is not mapped."
        doubts.append(CodedWarning("column_unsure", sentence))
    if current is None and asked is None:
        sentence = (
            "No column has the name of a torque; without one `identify` needs commands (cmd_JOINT), better with the "
            "servo's law (--controller)."
        )
        doubts.append(CodedWarning("column_missing", sentence))
    return _Draft({}, doubts)


def _propose_references(
    groups: Sequence[ColumnGroup], recorded: _Recorded, q: _Positions, robot: JointLimits, signal: str
) -> _Draft:
    """Return lines of the reference positions, in the unit of the positions unless their names contain another.

    Without forces they are commands to servos (`signal` is `cmd`), through whose loops the robot is identified.
    """
    chosen, warnings = choose_group(groups, "q_ref")
    columns, taken = _pair(chosen, robot.actuated)
    entries = {}
    for joint, column in columns.items():
        named = recorded.find_scale(column, "q")
        entries[f"{signal}_{joint}"] = _build_entry(column, q.scales.get(joint, 1.0) if named is None else named)
    return _Draft(entries, [*warnings, *taken])


def _build_entry(column: str, scale: float) -> Any:
    name = int(column) if re.fullmatch(r"[1-9]\d{0,8}", column, re.ASCII) else column
    return name if scale == 1.0 else {"column": name, "scale": scale}


def _format_entry(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_format_entry(part)}" for key, part in value.items()) + "}"
    return _quote(value) if isinstance(value, str) else repr(value)


def _quote(text: str) -> str:
    """Return text in a form that YAML reads back; quoted unless it is a plain word."""
    plain = re.fullmatch(r"[A-Za-z_][\w.]*", text, re.ASCII) and text.lower() not in _YAML_WORDS
    return text if plain else yaml.safe_dump(text, default_style='"', width=float("inf")).strip()


_YAML_WORDS = frozenset("y n yes no on off true false null".split())


def _one_line(sentence: str) -> str:
    return "".join(c if c.isprintable() else " " for c in sentence)
