"""A column map for a pose file: its columns by their names, and its conventions as far as a map can state them.

Signs, zeros, units and exchanged columns of joints and positions are one column each, `ours = scale * theirs + offset`: the
reading that was found is applied to unit vectors, which gives both. The order of a quaternion is an order of names. A map cannot
state shifted rows, inverse poses and kinds of angles; `calibrate` finds them by itself. The map is read back before it is
proposed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tau_dyn.calibrate.conventions.readings import PoseReading, Reading, apply_reading
from tau_dyn.calibrate.conventions.search import FoundReading
from tau_dyn.calibrate.measured import (
    LOADS,
    POSITION,
    QUATERNION,
    PoseSet,
    find_pose_columns,
    get_unit_factor,
    read_poses,
)
from tau_dyn.log import ColumnMap, ColumnProposal, Source, Table, format_names, read_table, split_words
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

_TABLES = (".csv", ".parquet", ".txt", ".dat", ".tsv")
_MAX_BARE_POSES = 5000
"""Rows of a file without a header above which it is a log."""
_OF_LOGS = {"tau", "torque", "effort", "force", "current", "cmd", "ref"}
"""Words in the columns of a log of forces or commands, which is no pose file."""


def build_pose_proposal(
    path: str | Path,
    robot: Robot,
    find: Callable[[PoseSet], FoundReading | None],
    explains: Callable[[PoseSet], bool],
) -> ColumnProposal | None:
    """Return the map proposed for a pose file, None if the file holds no poses of a robot.

    Args:
        path: A text table or Parquet.
        robot: The robot.
        find: Returns the conventions of poses, as `calibrate` finds them.
        explains: Returns whether the robot file explains poses as they are written, or by conventions that `find` returns.

    Raises:
        InputError: A pose file with cells that are no numbers.
    """
    if Path(path).suffix.lower() not in _TABLES or Path(path).is_dir():
        return None
    table = read_table(path, foreign=True)
    sources = {name: name for name in table.cells} | find_pose_columns(table, robot.actuated)
    joints = [f"q_{joint}" for joint in robot.actuated]
    numbered = {} if set(joints) <= set(sources) else _find_numbered_joints(table, robot)
    numbered = numbered or _find_bare_columns(path, table, robot, explains)
    sources |= {name: source.column for name, source in numbered.items()}
    words = {word for column in table.cells for word in split_words(column)}
    if not all(name in sources for name in (*joints, *POSITION)) or words & _OF_LOGS:
        return None
    turned = QUATERNION if all(name in sources for name in QUATERNION) else ()
    names = [*joints, *POSITION, *turned, *(name for name in LOADS if name in table.cells)]
    plain = {
        name: Source(sources[name], get_unit_factor(sources[name]) if sources[name] != name else 1.0) for name in names
    }
    plain |= numbered
    doubts = _describe_numbered(numbered, robot)
    found = find(read_poses(path, robot.actuated, columns=ColumnMap(numbered) if numbered else None))
    if found is None:
        return ColumnProposal(table.name, table.sha256, tuple(robot.actuated), ColumnMap(plain).to_dict(), doubts)
    stated = tuple(change for change in found.reading if _can_be_stated(change))
    left = [change for change in found.reading if change not in stated]
    meant = ColumnMap(_apply(stated, plain, joints) | _list_speeds(stated, table.cells, joints))
    again = find(read_poses(path, robot.actuated, columns=meant))
    remaining = {change.cause for change in again.reading} if again else set()
    if stated and not remaining <= {change.cause for change in left}:
        meant, left = ColumnMap(plain), list(found.reading)
    warnings = [*doubts, found.describe(table.name)]
    if left:
        said = " and ".join(change.words for change in left)
        warnings.append(CodedWarning("poses_reread", f"no map states that {said}; `calibrate` finds it by itself"))
    return ColumnProposal(table.name, table.sha256, tuple(robot.actuated), meant.to_dict(), tuple(warnings))


def _find_numbered_joints(table: Table, robot: Robot) -> dict[str, Source]:
    """Return the columns of all joints, by our names, in a file without a clock that has a number a joint."""
    stems: dict[str, list[tuple[int, str]]] = {}
    for column in table.cells:
        if column.lower() in _CLOCKS:
            return {}
        if (m := re.fullmatch(r"(\D*?)[ _]?(\d+)", column)) and table.numbers_or_none(column) is not None:
            stems.setdefault(m[1], []).append((int(m[2]), column))
    runs = [sorted(of) for of in stems.values() if len(of) == len(robot.actuated)]
    runs = [run for run in runs if [k for k, _ in run] == list(range(run[0][0], run[0][0] + len(run)))]
    if len(runs) != 1:
        return {}
    return {f"q_{joint}": Source(column) for joint, (_, column) in zip(robot.actuated, runs[0], strict=True)}


def _find_bare_columns(
    path: str | Path, table: Table, robot: Robot, explains: Callable[[PoseSet], bool]
) -> dict[str, Source]:
    """Return the columns of all joints and positions, by our names, in a file without a header that holds such poses.

    Joints may come before or after the pose, whose orientation, if there is one, has three numbers or four; only the robot file
    tells whether they do. Orientations are left for a map by hand, as their kind is unknown.
    """
    columns, n = list(table.cells), len(robot.actuated)
    is_bare = columns == [str(k + 1) for k in range(len(columns))]
    if not is_bare or len(columns) - n not in (3, 6, 7) or table.n_rows > _MAX_BARE_POSES:
        return {}
    joints = [f"q_{joint}" for joint in robot.actuated]
    for first, place in ((0, n), (len(columns) - n, 0)):
        named = dict(zip(joints, columns[first : first + n], strict=True))
        named |= dict(zip(POSITION, columns[place : place + 3], strict=True))
        found = {name: Source(column) for name, column in named.items()}
        if explains(read_poses(path, robot.actuated, columns=ColumnMap(found))):
            return found
    return {}


def _describe_numbered(numbered: Mapping[str, Source], robot: Robot) -> tuple[str, ...]:
    """Return the doubt about joints whose columns carry numbers."""
    if not numbered:
        return ()
    columns = [numbered[f"q_{joint}"].column for joint in robot.actuated]
    joints = format_names(robot.actuated)
    sentence = f"{columns[0]} to {columns[-1]} carry numbers, not names, and are taken for {joints} in this order"
    return (CodedWarning("column_unsure", sentence),)


_CLOCKS = frozenset(("t", "time", "timestamp", "stamp"))
"""Columns of a recording."""


def _can_be_stated(change: PoseReading) -> bool:
    """Return whether a column map can state a change."""
    return change.cause == "quaternion_order" or (
        change.acts_on in ("joints", "positions") and change.cause not in ("row_shift", "")
    )


def _apply(reading: Reading, plain: Mapping[str, Source], joints: list[str]) -> dict[str, Source]:
    """Return the column of each of our names after a reading."""
    n, out = len(joints), _apply_to_joints(reading, plain, joints)
    of_positions = tuple(change for change in reading if change.acts_on == "positions")
    x = np.vstack([np.zeros((1, 3)), np.eye(3)])
    out |= _carry(plain, POSITION, apply_reading(of_positions, PoseSet(np.zeros((4, n)), x)).position)
    if QUATERNION[0] in plain and any(change.cause == "quaternion_order" for change in reading):
        out |= {name: plain[QUATERNION[(k + 1) % 4]] for k, name in enumerate(QUATERNION)}
    return out


def _apply_to_joints(reading: Reading, plain: Mapping[str, Source], joints: list[str]) -> dict[str, Source]:
    """Return all columns, with the joints' columns after a reading."""
    n = len(joints)
    of_joints = tuple(change for change in reading if change.acts_on == "joints")
    q = np.vstack([np.zeros((1, n)), np.eye(n)])
    return dict(plain) | _carry(plain, joints, apply_reading(of_joints, PoseSet(q, np.zeros((n + 1, 3)))).q)


def _carry(plain: Mapping[str, Source], names: Sequence[str], values: np.ndarray) -> dict[str, Source]:
    """Return the columns of names that are there, from the images of zero and of unit vectors under a reading (n + 1, n)."""
    if not set(names) <= set(plain):
        return {}
    out, offset, slope = {}, values[0], (values[1:] - values[0]).T
    for row, name in enumerate(names):
        column = int(np.argmax(np.abs(slope[row])))
        source = plain[names[column]]
        out[name] = replace(source, scale=float(slope[row, column]) * source.scale, offset=float(offset[row]))
    return out


def _list_speeds(reading: Reading, columns: Container[str], joints: list[str]) -> dict[str, Source]:
    """Return the columns of the joints' speeds after a reading, empty if the file has no speeds: they have no offset."""
    speeds = [name.replace("q_", "v_", 1) for name in joints]
    if not all(name in columns for name in speeds):
        return {}
    moved = _apply_to_joints(reading, {name: Source(speed) for name, speed in zip(joints, speeds, strict=True)}, joints)
    return {speed: replace(moved[name], offset=0.0) for name, speed in zip(joints, speeds, strict=True)}
