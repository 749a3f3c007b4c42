"""A foreign log's columns and a robot's joints become a proposed column map, with a sentence for each doubt.

A column's name is split into words. They say what it is (position, velocity, torque, a reference, a current, a clock) and in
which unit; the joint's name or a number says whose. Columns of one such name are a group, and a group that has every actuated
joint is a candidate. Units that no name says are told by magnitude: positions by the joints' limits, clocks by their step. A
velocity has to be the derivative of the position, whose slope also tells its unit. Currents are no torques: the torque
constant is not in a log, and is not invented.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log.check import JointLimits
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import format_names, is_contract_name, split_column_name
from tau_dyn.log.read import EPISODE, has_topics, read_any
from tau_dyn.log.table import Table
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

_DEGREE = np.pi / 180

_WORDS: Mapping[str, frozenset[str]] = {
    "reference": frozenset("target goal cmd command commanded desired des ref reference setpoint sp d action".split()),
    "current": frozenset("current currents curr cur ampere amps motorcurrent".split()),
    "tau": frozenset("tau torque torques effort efforts trq moment moments".split()),
    "v": frozenset("v vel velocity velocities speed speeds dq qd qdot omega".split()),
    "a": frozenset("a acc acceleration accelerations ddq qdd".split()),
    "q": frozenset("q qm pos position positions angle angles theta state".split()),
    "temp": frozenset("temp temperature temperatures".split()),
    "other": frozenset("tcp tool ee cartesian pose ext external volts voltage error fric friction con load".split()),
}
"""What a word of a name says; the first row that knows one decides, after `other` and `reference`."""

_SCALES: Mapping[str, Mapping[str, float]] = {
    "t": {"ns": 1e-9, "nanoseconds": 1e-9, "us": 1e-6, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3, "s": 1.0, "sec": 1.0},
    "q": {"deg": _DEGREE, "degrees": _DEGREE, "rad": 1.0, "mm": 1e-3, "m": 1.0},
    "v": {"deg": _DEGREE, "degrees": _DEGREE, "rad": 1.0, "rpm": np.pi / 30, "mm": 1e-3},
    "tau": {"nm": 1.0, "mnm": 1e-3, "ncm": 1e-2},
}  # fmt: skip
"""Units that a name may say, and their size in SI."""

_CLOCKS = frozenset("t time timestamp timestamps stamp clock zeit secs seconds".split())

_MEASURED = frozenset("actual act measured meas".split())
"""Words that make a group the better candidate."""

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


class _Group(NamedTuple):
    """Columns of one name, a joint each: what they are, and by which word they are called."""

    kind: str  # a signal, `q_ref`, `current`, `other`, or nothing
    stem: tuple[str, ...]
    columns: tuple[str, ...]  # in the robot's order
    by_name: bool
    more: int = 0  # numbers beyond the joints

    def score(self) -> tuple[bool, int]:
        """Return how likely it is to be what was measured."""
        return self.by_name, len(_MEASURED & set(self.stem)) - ("filt" in self.stem or "filtered" in self.stem)


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
    warnings: list[str] = []
    entries: dict[str, Any] = {}
    if EPISODE in table.cells:
        table, episode = _choose_episode(table, warnings)
        entries["episode"] = episode
    own = {f"cmd_{joint}" for joint in robot.actuated}  # which keep their name
    values = {c: x for c in table.cells if c not in own and (x := _find_numbers(table, c)) is not None}
    if has_topics(Path(path)) and "t" in values:  # a reader gives that clock with any map; a map names fields
        t = values["t"]
        fields = {c: x for c, x in values.items() if not is_contract_name(c)}
        values = fields if any("position" in _split_words(c) for c in fields) else values
    else:
        t = _propose_clock(table.name, values, entries, warnings)
    groups = _find_groups([c for c in values if c not in _list_named(entries)], robot.actuated, Path(path).stem)
    _guess_numbered(groups, values, t, robot, warnings)
    q = _propose_positions(table, groups, values, robot, entries, warnings)
    _propose_velocities(groups, values, t, q, robot, entries, warnings)
    _propose_forces(groups, values, robot, entries, warnings)
    references = _choose(groups, "q_ref", warnings)
    for k, column in enumerate(references.columns if references else ()):
        named = _name_scale(column, "q")
        entries[f"q_ref_{robot.actuated[k]}"] = _build_entry(column, q.scales[k] if named is None else named)
    return ColumnProposal(table.name, table.sha256, tuple(robot.actuated), entries, tuple(warnings))


def _read(path: Path) -> Table:
    """Read all columns, as a map's reader does."""
    return read_any(path) if has_topics(path) else read_any(path, {})


def _find_numbers(table: Table, column: str) -> NDArray[np.float64] | None:
    """Return a column (N,) of finite numbers, or None."""
    if table.cells[column].dtype.kind == "b":
        return None
    values = table.numbers_or_none(column)
    return values if values is not None and values.size and np.all(np.isfinite(values)) else None


def _choose_episode(table: Table, warnings: list[str]) -> tuple[Table, int]:
    """Return the first episode's rows and number."""
    numbers = table.numbers(EPISODE)
    first, n_episodes = int(numbers[0]), np.unique(numbers).size
    if n_episodes > 1:
        warnings.append(
            CodedWarning(
                "column_unsure",
                f"{table.name} holds {n_episodes} episodes, which are logs of their own; the map takes episode {first}.",
            )
        )
    return table.take_rows(np.flatnonzero(numbers == numbers[0])), first


def _list_named(entries: Mapping[str, Any]) -> set[str]:
    """Return the foreign columns that entries name."""
    return {value["column"] if isinstance(value, dict) else str(value) for value in entries.values()}


def _split_words(name: str) -> tuple[str, ...]:
    """Return a name's words in lower case, numbers among them."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))


def _doubt(warnings: list[str], code: str, sentence: str) -> None:
    warnings.append(CodedWarning(code, sentence))


def _propose_clock(
    name: str, values: Mapping[str, NDArray[np.float64]], entries: dict[str, Any], warnings: list[str]
) -> NDArray[np.float64] | None:
    """Add the clock and return its times (N,) [s]; None where there is none."""
    rising = [c for c, x in values.items() if x.size > 1 and np.all(np.diff(x) > 0)]
    named = [c for c in values if _CLOCKS & set(_split_words(c)[:1] + _split_words(c)[-2:])]
    column = next((c for c in named if c in rising), None)
    if column is None and named:
        _doubt(warnings, "column_unsure", f"{named[0]} is not taken for the clock: it does not rise from row to row.")
    if column is None and "1" in rising and "2" in values:
        column = "1"
        _doubt(warnings, "column_unsure", f"{name}: column 1 rises throughout and is taken for the clock.")
    if column is None:
        _doubt(
            warnings,
            "column_missing",
            f"{name} has no clock; add `t: {{rate_hz: F}}` with the rate of the recording [Hz].",
        )
        return None
    scale = _name_scale(column, "t")
    step = float(np.median(np.diff(values[column])))
    if scale is None:
        scale = next(s for s in (1.0, 1e-3, 1e-6, 1e-9) if step * s <= MAX_SECONDS_STEP or s == 1e-9)
        if scale != 1.0:
            _doubt(
                warnings, "unit_unsure",
                f"{column} steps by {step:.6g}, which is taken for {_TIME_UNITS[scale]}: {1 / (step * scale):.6g} Hz.",
            )  # fmt: skip
    entries["t"] = _build_entry(column, scale)
    return scale * (values[column] - values[column][0])


_TIME_UNITS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}


def _name_scale(column: str, kind: str) -> float | None:
    """Return the size of the unit that a column's name says; None where it says none."""
    words = _split_words(column)[1:]
    return next((scale for unit, scale in _SCALES[kind].items() if unit in words), None)


def _classify(words: Sequence[str]) -> str:
    """Return what a name's words stand for; nothing where they say nothing."""
    known = set(words)
    if known & _WORDS["other"]:
        return "other"
    kind = next((k for k in ("current", "tau", "v", "a", "q", "temp") if known & _WORDS[k]), "")
    if known & _WORDS["reference"]:
        if "action" in known:
            return "q_ref"
        return {"q": "q_ref", "": "q_ref", "tau": "tau_ref"}.get(kind, "other")
    return kind


def _find_groups(columns: Sequence[str], joints: Sequence[str], file: str) -> list[_Group]:
    """Return the groups of columns that have every joint, by its name or by numbers."""
    stems: dict[tuple[str, ...], dict[int | str, str]] = {}
    for column in columns:
        for stem, key in _split_joint(column, joints):
            stems.setdefault(stem, {}).setdefault(key, column)
    groups = []
    for stem, found in stems.items():
        by_name = all(joint in found for joint in joints)
        numbers = sorted(key for key in found if isinstance(key, int))
        more = 0
        if by_name:
            order = tuple(found[joint] for joint in joints)
        elif len(joints) == 1 and "" in found:
            order = (found[""],)
        elif len(numbers) >= len(joints) and numbers[0] in (0, 1) and np.all(np.diff(numbers) == 1):
            order = tuple(found[key] for key in numbers[: len(joints)])
            more = len(numbers) - len(joints)
        else:
            continue
        kind = _classify(stem) or ("" if not set(stem) <= {"joint", "axis", "j"} else _classify(_split_words(file)))
        groups.append(_Group(kind, stem, order, by_name, more))
    return groups


def _split_joint(column: str, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], int | str]]:
    """Yield a column's words without its joint, and the joint's name or number."""
    ours = split_column_name(column)
    if ours is not None and ours[1] in joints:
        yield _split_words(ours[0]), ours[1]
        return
    words = _split_words(column)
    for joint in sorted(joints, key=len, reverse=True):
        part = _split_words(joint)
        for at in range(len(words) - len(part) + 1):
            if part and words[at : at + len(part)] == part:
                yield words[:at] + words[at + len(part) :], joint
                return
    numbers = [k for k, word in enumerate(words) if word.isdigit()]
    if numbers and len(words) > 1:
        k = numbers[-1]
        yield words[:k] + words[k + 1 :], int(words[k][:9])
    yield words, ""


def _guess_numbered(
    groups: list[_Group],
    values: Mapping[str, NDArray[np.float64]],
    t: NDArray[np.float64] | None,
    robot: JointLimits,
    warnings: list[str],
) -> None:
    """Add groups for a file without a header: blocks of one column a joint, in the robot's order."""
    names = [c for c in values if c.isdigit()]
    n = len(robot.actuated)
    if len(names) != len(values):
        return
    free = names[1:] if t is not None else names
    blocks = [tuple(free[k : k + n]) for k in range(0, len(free) - n + 1, n)]
    groups.clear()
    if not blocks:
        return
    pairs = [(a, b) for a in blocks for b in blocks if a != b]
    moving = next((p for p in pairs if t is not None and _match_slope(p, values, t) is not None), None)
    if moving is None and len(free) > n:
        return  # several signals, and nothing tells them apart
    chosen = moving or (blocks[0],)
    groups += [_Group(kind, (), block, False) for kind, block in zip(("q", "v"), chosen, strict=False)]
    why = f"{moving[1][0]} to {moving[1][-1]} are their derivative" if moving else "there is nothing else"
    _doubt(
        warnings,
        "column_unsure",
        f"There is no header: columns {chosen[0][0]} to {chosen[0][-1]} are taken for positions, as {why}.",
    )
    if rest := [c for c in free if not any(c in block for block in chosen)]:
        _doubt(warnings, "column_unsure", f"Columns {format_names(rest)} are not mapped: nothing says what they are.")


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


def _choose(groups: Sequence[_Group], kind: str, warnings: list[str]) -> _Group | None:
    """Return the likeliest group of a kind; equally likely ones are a doubt."""
    found = sorted((g for g in groups if g.kind == kind), key=_Group.score, reverse=True)
    if len(found) > 1 and found[0].score() == found[1].score():
        others = format_names(g.columns[0] for g in found[1:])
        _doubt(
            warnings,
            "column_unsure",
            f"{found[0].columns[0]} is taken for {kind}, and {others} could be as well; choose by hand.",
        )
    return found[0] if found else None


class _Positions(NamedTuple):
    """Chosen positions: their columns, and what brings each one to SI units."""

    columns: tuple[str, ...]
    scales: tuple[float, ...]


def _propose_positions(
    table: Table,
    groups: Sequence[_Group],
    values: Mapping[str, NDArray[np.float64]],
    robot: JointLimits,
    entries: dict[str, Any],
    warnings: list[str],
) -> _Positions:
    """Add the positions."""
    chosen = _choose(groups, "q", warnings)
    if chosen is None:
        joints = robot.actuated
        raise CannotAnswer(
            "positions_missing",
            f"{table.name} has no columns that can be the positions of {format_names(joints)}; it has "
            f"{format_names(table.cells)}",
            f"name a position for {count(len(joints), 'joint')} in a column map, as `q_{joints[0]}: COLUMN`, or log them",
        )
    if not chosen.by_name and len(robot.actuated) > 1:
        _doubt(
            warnings,
            "column_unsure",
            f"{chosen.columns[0]} to {chosen.columns[-1]} carry numbers, not names, and are taken for "
            f"{format_names(robot.actuated)} in this order"
            + (f"; {chosen.more} more are left out." if chosen.more else "."),
        )
    scales = _find_position_scales(chosen.columns, values, robot, warnings)
    for joint, column, scale in zip(robot.actuated, chosen.columns, scales, strict=True):
        entries[f"q_{joint}"] = _build_entry(column, scale)
    return _Positions(chosen.columns, scales)


def _find_position_scales(
    columns: Sequence[str], values: Mapping[str, NDArray[np.float64]], robot: JointLimits, warnings: list[str]
) -> tuple[float, ...]:
    """Return what brings each joint's positions to m or rad; joints of a kind share a unit."""
    scales = np.ones(len(columns))
    kinds = np.array(robot.joint_kinds)
    for kind, small, unit in (("revolute", _DEGREE, "degrees"), ("prismatic", 1e-3, "mm")):
        mine = np.flatnonzero(kinds == kind)
        if not mine.size:
            continue
        named = _name_scale(columns[mine[0]], "q")
        if named is not None:
            scales[mine] = named
            continue
        fits = [all(_is_within(values[columns[k]] * s, robot, k) for k in mine) for s in (1.0, small)]
        if not fits[0] and fits[1]:
            scales[mine] = small
            _doubt(
                warnings,
                "unit_unsure",
                f"{columns[mine[0]]} is beyond the limits in SI units and within them in {unit}, and taken for "
                f"{unit}; a gear ratio looks alike.",
            )
        elif not any(fits):
            outside = next(k for k in mine if not _is_within(values[columns[k]], robot, k))
            _doubt(
                warnings,
                "unit_unsure",
                f"{columns[outside]} leaves the limits of {robot.actuated[outside]} in SI units and in {unit}: another "
                "unit, zero, gear ratio or joint; give scale and offset by hand.",
            )
    return tuple(map(float, scales))


def _is_within(q: NDArray[np.float64], robot: JointLimits, k: int) -> bool:
    """Tell whether positions lie within a joint's limits; without limits, within two turns or 10 m."""
    low, high = float(robot.lower[k]), float(robot.upper[k])
    if not np.isfinite(high - low):
        bound = 4 * np.pi if robot.joint_kinds[k] == "revolute" else 10.0
        return bool(np.all(np.abs(q) <= bound))
    margin = LIMIT_MARGIN * (high - low)
    return bool(np.all((q >= low - margin) & (q <= high + margin)))


def _propose_velocities(
    groups: Sequence[_Group],
    values: Mapping[str, NDArray[np.float64]],
    t: NDArray[np.float64] | None,
    q: _Positions,
    robot: JointLimits,
    entries: dict[str, Any],
    warnings: list[str],
) -> None:
    """Add the velocities that are the positions' derivative."""
    chosen = _choose(groups, "v", warnings)
    if chosen is None:
        return
    for k, (joint, column) in enumerate(zip(robot.actuated, chosen.columns, strict=True)):
        pair = ((q.columns[k],), (column,))
        slope = None if t is None else _match_slope(pair, values, t)
        still = np.ptp(values[q.columns[k]]) == 0.0 or np.ptp(values[column]) == 0.0
        named = _name_scale(column, "v")
        scale = named if named is not None else q.scales[k] if t is None or still else 1.0
        if slope is None and not still:
            why = "without a clock nobody can tell whether it is" if t is None else "it is not"
            _doubt(warnings, "column_unsure", f"{column} is not mapped: {why} the derivative of {q.columns[k]}.")
            continue
        if slope is not None:
            scale = _round_scale(slope * q.scales[k], scale)
            if scale is None:
                _doubt(
                    warnings,
                    "unit_unsure",
                    f"{column} is not mapped: times {slope * q.scales[k]:.4g} it is the derivative of "
                    f"{q.columns[k]}, and no unit is so.",
                )
                continue
        entries[f"v_{joint}"] = _build_entry(column, scale)


def _round_scale(slope: float, likely: float) -> float | None:
    """Return the unit's size that a slope means, the likely one first; None where none is near."""
    sizes = (likely, 1.0, _DEGREE, np.pi / 30, 1e-3)
    return next((s for s in sizes if abs(slope / s - 1) <= MAX_SLOPE_ERROR), None)


def _propose_forces(
    groups: Sequence[_Group],
    values: Mapping[str, NDArray[np.float64]],
    robot: JointLimits,
    entries: dict[str, Any],
    warnings: list[str],
) -> None:
    """Add measured torques; say what currents and controllers' torques lack."""
    chosen = _choose(groups, "tau", warnings)
    if chosen is not None:
        scales = [_name_scale(column, "tau") for column in chosen.columns]
        for joint, column, scale in zip(robot.actuated, chosen.columns, scales, strict=True):
            entries[f"tau_{joint}"] = _build_entry(column, 1.0 if scale is None else scale)
        if chosen.columns[0] != f"tau_{robot.actuated[0]}":
            unit = "" if scales[0] else " in N m (N of a sliding joint)"
            _doubt(
                warnings, "unit_unsure", f"{chosen.columns[0]} is taken for the torque behind the gear{unit}; "
                "one at the motor takes the gear ratio as its scale.",
            )  # fmt: skip
        return
    current = _choose(groups, "current", warnings)
    if current is not None:
        _doubt(
            warnings,
            "torque_constant_missing",
            f"{current.columns[0]} is a current, not a torque; give the torque constant behind the gear [N m/A] as "
            f"`tau_{robot.actuated[0]}: {{column: {current.columns[0]}, scale: CONSTANT}}`.",
        )
    asked = _choose(groups, "tau_ref", [])
    if asked is not None:
        _doubt(
            warnings,
            "column_unsure",
            f"{asked.columns[0]} is what the controller asks for, not a measurement, and is not mapped.",
        )
    if current is None and asked is None:
        _doubt(warnings, "column_missing", "No column is a torque; without one `identify` needs the controller.")


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
