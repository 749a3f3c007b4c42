"""Measured poses from CSV or Parquet: their columns, names of campaigns, targets and devices, standard errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.measured.columns import ANGLES, name_pose_columns, read_angles
from tau_dyn.calibrate.measured.encoders import PassiveEncoders
from tau_dyn.calibrate.measured.kinds import TOUCHES
from tau_dyn.calibrate.measured.loads import read_loads
from tau_dyn.calibrate.measured.pose_set import PoseSet, join_pose_sets
from tau_dyn.exceptions import InputError, require_kind
from tau_dyn.log import ColumnMap, Table, compute_mapped_columns, format_names, is_blank, read_table
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Mimic, Robot, read_annotations

POSITION = ("x_tool", "y_tool", "z_tool")
STDERRS = ("x_tool_stderr", "y_tool_stderr", "z_tool_stderr")
ROTATION_STDERR = "rot_tool_stderr"
QUATERNION = ("qx_tool", "qy_tool", "qz_tool", "qw_tool")
DISTANCE = "distance_tool"
_MAX_COORDINATE_M = 1e3  # [m] from the device; a larger coordinate means a file in mm
_MAX_ROOM_M = 50.0  # [m] from the device in most rows; otherwise far rows are not single errors, but all rows are in mm


def as_poses(poses: PoseSet | str | Path, robot: Robot) -> PoseSet:
    """Return poses as they are, or read a file of them; see `read_poses`.

    Raises:
        InputError: The argument is neither poses nor a path, or the file cannot be used.
    """
    if isinstance(poses, PoseSet):
        return poses
    require_kind(poses, str | Path, "set of poses", "a PoseSet, or a file's path")
    return read_poses(poses, robot.actuated, mimics=read_annotations(robot.urdf, robot.source).mimics)


def read_poses(
    path: str | Path,
    actuated: Sequence[str],
    *,
    columns: ColumnMap | str | Path | None = None,
    mimics: Mapping[str, Mimic] | None = None,
    encoders: PassiveEncoders | None = None,
) -> PoseSet:
    """Read measured poses from CSV or Parquet, with the columns `q_J`, `x_tool y_tool z_tool` and maybe `qx_tool` .. `qw_tool`.

    Without a quaternion `rx_tool ry_tool rz_tool` are a rotation vector or three angles; other usual names are read, with a
    warning (`columns.py`). `x_tool_stderr` .. `z_tool_stderr` [m] and `rot_tool_stderr` [rad] are standard errors that
    weigh the poses; a zero counts as the smallest of its column above zero. A column `campaign` identifies measuring campaigns,
    a column `target` the targets on the tool, a column `device` the devices; the signs of `v_J` give the side from which a joint
    came, and without them the order of the file does. Known loads on the tool are in `load` [kg], `fx_tool` .. [N] and
    `mx_tool` .. [N m] (`loads.py`).

    A row may have another measurement than a position: `distance_tool` [m] from the point that `device` names, or the name of
    the touched fixture in a column `hole`, `plane` or `sphere`. Passive joints with encoders are read from their columns `q_J`,
    in addition to or instead of these. Places on the way of a plan (`pose` 0) are left out.

    Args:
        path: File.
        actuated: Actuated joints of the robot, in its order.
        columns: Map for foreign columns, or the path of one; its `couplings` undo coupled transmissions.
        mimics: Joints that follow others in the robot file; a column that they lack is computed.
        encoders: Passive joints that have encoders; an empty cell was not read.

    Raises:
        InputError: Columns are missing, cells are no numbers, or quaternions no orientations.
    """
    table = read_table(path, foreign=columns is not None)
    if columns is not None:
        table = _rename_columns(table, columns if isinstance(columns, ColumnMap) else ColumnMap.load(columns))
    table = _follow_mimics(table, mimics or {})
    passive = () if encoders is None else tuple(encoders.kinds)
    table = name_pose_columns(table, actuated, passive)
    _check_columns(table, actuated, passive)
    table = _leave_out_ways(table, passive)
    q = np.column_stack([_numbers(table, f"q_{joint}") for joint in actuated])
    campaign, campaigns = _number_words(table, "campaign")
    target, targets = _number_words(table, "target")
    motion = _read_motion(table, actuated, q)
    rows = PoseSet(
        q=q,
        position=np.zeros((len(q), 3)),
        names=tuple(table.where(k) for k in range(table.n_rows)),
        campaign=campaign,
        campaigns=campaigns,
        target=target,
        targets=targets,
        approach=_approach(table, actuated, q),
        speed=motion[0],
        acceleration=motion[1],
        jerk=motion[2],
        loads=read_loads(table),
        source=table.name,
        sha256=table.sha256,
        warnings=table.warnings,
    )
    if encoders is None:
        return _read_tool(table, rows)
    readings = {joint: table.numbers(f"q_{joint}", gaps=True) for joint in passive}
    read = np.any([np.isfinite(values) for values in readings.values()], axis=0)
    of_tool = np.flatnonzero(_find_tool_rows(table) | ~read)
    sets = [_read_tool(table.take_rows(of_tool), rows.take(of_tool))] if len(of_tool) else []
    bare = replace(rows, warnings=() if sets else rows.warnings)
    if sets and sets[0].rotation is not None:
        bare = replace(bare, rotation=np.repeat(np.eye(3)[None], len(q), axis=0))
    sets += [
        encoders.measure(joint, values, replace(bare, warnings=() if k else bare.warnings))
        for k, (joint, values) in enumerate(readings.items())
        if np.isfinite(values).any()
    ]
    return replace(join_pose_sets(sets), source=table.name, sha256=table.sha256)


def _read_tool(table: Table, rows: PoseSet) -> PoseSet:
    """Return the rows (N) with a measurement of the tool by a device or a fixture."""
    position, device, devices, kinds = _read_measurements(table)
    (stated, said), (turned, more) = _read_position_stderr(table, kinds), _read_stated(table, (ROTATION_STDERR,))
    rotation, angles, how = (None, None, "") if set(kinds) - {"pose"} else _read_orientation(table)
    poses = replace(
        rows,
        position=position,
        rotation=rotation,
        device=device,
        devices=devices,
        kinds=kinds,
        position_stderr=stated,
        rotation_stderr=None if turned is None or rotation is None else turned[:, 0],
        angles=angles,
        warnings=(
            *rows.warnings,
            *([CodedWarning("columns_read", f"{table.name}: {how}")] if how else []),
            *said,
            *more,
        ),
    )
    if np.median(np.abs(position).max(axis=1)) < _MAX_ROOM_M:  # otherwise the whole file has another unit
        check_units(poses)
    return poses


def _find_tool_rows(table: Table) -> np.ndarray:
    """Return whether the tool is measured in each row (N,)."""
    given = np.zeros(table.n_rows, bool)
    for name in (*POSITION, DISTANCE, *TOUCHES):
        if name in table.cells:
            given |= [not is_blank(cell) for cell in table.cells[name]]
    return given


def _leave_out_ways(table: Table, passive: Sequence[str]) -> Table:
    """Return the table without the unmeasured places of a plan: `pose` 0 and no measurement."""
    if "pose" not in table.cells:
        return table
    given = _find_tool_rows(table)
    for joint in passive:
        given |= [not is_blank(cell) for cell in table.cells[f"q_{joint}"]]
    on_the_way = np.array([str(cell).strip() in ("0", "0.0") for cell in table.cells["pose"]], bool) & ~given
    return table.take_rows(np.flatnonzero(~on_the_way)) if on_the_way.any() else table


def _read_measurements(table: Table) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """Return positions (N, 3) as `PoseSet` has them, the device of each row (N,), the devices' names and kinds.

    Raises:
        InputError: A row has no measurement or several, or a device measures different quantities.
    """
    given = {"pose": _is_filled(table, POSITION), "distance": _is_filled(table, (DISTANCE,))}
    given |= {kind: _is_filled(table, (kind,)) for kind in TOUCHES}
    many = np.sum(list(given.values()), axis=0)
    if np.any(many != 1):
        k = int(np.argmax(many != 1))
        wanted = format_names([name for name in (*POSITION, DISTANCE, *TOUCHES) if name in table.cells])
        how = "several measurements" if many[k] else "no whole measurement"
        raise InputError(
            "bad_sample", f"{table.where(k)}: {how} in {wanted}; a row gives one position, distance or touch"
        )
    words = table.cells["device"].astype(str) if "device" in table.cells else None
    name = np.full(table.n_rows, "", dtype=object)
    position, kind_of = np.zeros((table.n_rows, 3)), {}
    for kind, own in given.items():
        if kind in TOUCHES:
            name[own] = [f"{kind} {word}" for word in table.cells[kind][own].astype(str)] if own.any() else ""
        else:
            name[own] = words[own] if words is not None else "1" if kind == "pose" else kind
        for each in dict.fromkeys(name[own]):
            if kind_of.setdefault(each, kind) != kind:
                raise InputError("mismatch", f"{table.name}: device {each} measures {kind_of[each]} and {kind}")
    for columns, kind in ((POSITION, "pose"), ((DISTANCE,), "distance")):
        own = given[kind]
        if own.any():
            values = np.column_stack([table.numbers(c, gaps=not own.all()) for c in columns])
            position[own, : len(columns)] = values[own]
    devices = tuple(dict.fromkeys(name.tolist()))
    number = {word: k for k, word in enumerate(devices)}
    return position, np.array([number[x] for x in name], int), devices, tuple(kind_of[x] for x in devices)


def _is_filled(table: Table, names: Sequence[str]) -> np.ndarray:
    """Return whether all of these columns have a cell in each row (N,); the only measurement of a table counts as filled."""
    if not all(name in table.cells for name in names):
        return np.zeros(table.n_rows, bool)
    others = [name for name in (*POSITION, DISTANCE, *TOUCHES) if name in table.cells and name not in names]
    if not others:  # an empty cell is then a fault of the cell, not another kind of row
        return np.ones(table.n_rows, bool)
    return np.all([[not is_blank(cell) for cell in table.cells[name]] for name in names], axis=0)


def _read_position_stderr(table: Table, kinds: Sequence[str]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return standard errors of positions (N, 3) [m], those of a distance three times; None unless all rows have one."""
    if set(kinds) == {"distance"}:
        stated, said = _read_stated(table, (f"{DISTANCE}_stderr",))
        return None if stated is None else np.repeat(stated, 3, axis=1), said
    return _read_stated(table, STDERRS) if set(kinds) == {"pose"} else (None, ())


def _read_orientation(table: Table) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Return rotations (N, 3, 3), the three angles as written (N, 3), and how they are read; None if not measured."""
    return read_angles(table) if _has_angles(table) else (_rotations(table), None, "")


def _rename_columns(table: Table, map_: ColumnMap) -> Table:
    """Return the table with the map's columns in our names and units next to its others.

    Raises:
        InputError: The map reads further files.
    """
    if map_.files:
        raise InputError("unsupported", f"{map_.name}: poses are in one file; leave out files")
    return replace(table, cells={**table.cells, **compute_mapped_columns({None: table}, map_)})


def _follow_mimics(table: Table, mimics: Mapping[str, Mimic]) -> Table:
    """Return the table with the positions of joints that follow others, if it lacks them."""
    cells = dict(table.cells)
    for _ in mimics:  # a joint may follow one that follows another
        for joint, mimic in mimics.items():
            if f"q_{joint}" not in cells and f"q_{mimic.joint}" in cells:
                known = replace(table, cells=cells).numbers(f"q_{mimic.joint}")
                cells[f"q_{joint}"] = mimic.multiplier * known + mimic.offset
    return replace(table, cells=cells)


MAX_LISTED = 40
"""Number of columns up to which a refusal lists all: joints, pose, errors and names of a pose file."""


def _check_columns(table: Table, actuated: Sequence[str], passive: Sequence[str]) -> None:
    other = bool(passive) or any(name in table.cells for name in (DISTANCE, *TOUCHES))
    wanted = [*(f"q_{joint}" for joint in (*actuated, *passive)), *(() if other else POSITION)]
    missing = [name for name in wanted if name not in table.cells]
    if missing:
        raise InputError(
            "missing_column",
            f"{table.name} has no column {format_names(missing)}; calibration poses need {format_names(wanted)} "
            f"(or {DISTANCE}, or the touched object: {format_names(TOUCHES)}) and, where the orientation "
            f"was measured, {format_names(QUATERNION)}, or a rotation vector or Euler angles {format_names(ANGLES)}; "
            f"it has {format_names(table.cells, limit=MAX_LISTED)}. `tau-dyn columns {table.name} ROBOT --out map.yaml` proposes "
            "a map for --columns",
        )
    some = [name for name in QUATERNION if name in table.cells]
    if some and len(some) < 4:
        lacking = [name for name in QUATERNION if name not in some]
        raise InputError(
            "file_format",
            f"{table.name} has {format_names(some)} but not {format_names(lacking)}; a quaternion needs all four",
        )


def _read_stated(table: Table, names: Sequence[str]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return standard errors (N, k) from the table, None if it has no such columns, and a warning of zeros.

    A zero is a scatter below the last digit that was written: it counts as the smallest one above zero in its column.

    Raises:
        InputError: Some columns are missing, a standard error is below zero, or all of a column are zero.
    """
    some = [name for name in names if name in table.cells]
    if not some:
        return None, ()
    if len(some) < len(names):
        lacking = [name for name in names if name not in some]
        raise InputError("missing_column", f"{table.name} has {format_names(some)} but not {format_names(lacking)}")
    values = np.column_stack([_numbers(table, name) for name in names])
    bad = np.flatnonzero(((values < 0) | ~(values > 0).any(axis=0)).any(axis=1))
    if len(bad):
        raise InputError(
            "bad_sample", f"{table.where(int(bad[0]))}: a standard error ({format_names(names)}) must be above zero"
        )
    zero = values == 0
    if not zero.any():
        return values, ()
    smallest = np.where(zero, np.inf, values).min(axis=0)
    row = int(np.flatnonzero(zero.any(axis=1))[0])
    rounded = [
        f"{name} {x:.3g}" for name, x, any_zero in zip(names, smallest, zero.any(axis=0), strict=True) if any_zero
    ]
    sentence = (
        f"{table.name}: {int(zero.sum())} standard errors are zero (first {table.where(row)}), below the last digit that was "
        f"written; they count as the smallest of their column above zero ({', '.join(rounded)})"
    )
    return np.where(zero, smallest, values), (CodedWarning("stderr_rounded", sentence),)


def _numbers(table: Table, name: str) -> np.ndarray:
    values = table.numbers(name)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(
            "bad_sample",
            f"{table.where(int(bad[0]))}, column {name}: not a number; take the pose out or measure it again",
        )
    return values


def check_units(poses: PoseSet) -> None:
    """Refuse positions that are too large to be in m.

    Raises:
        InputError: A position is too far away; the message names the farthest pose.
    """
    far = np.abs(poses.position).max(axis=1)
    if np.any(far > _MAX_COORDINATE_M):
        k = int(np.argmax(far))
        raise InputError(
            "wrong_unit", f"{poses.names[k]}: the tool is {far[k]:.0f} m from the device; positions are in m, not in mm"
        )


def _has_angles(table: Table) -> bool:
    """Return whether orientations are three numbers; a quaternion has precedence."""
    return QUATERNION[0] not in table.cells and all(name in table.cells for name in ANGLES)


def _rotations(table: Table) -> np.ndarray | None:
    if QUATERNION[0] not in table.cells:
        return None
    quaternion = np.column_stack([_numbers(table, name) for name in QUATERNION])
    length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 1e-2)
    if len(wrong):
        k = int(wrong[0])
        raise InputError(
            "bad_sample",
            f"{table.where(k)}: the quaternion {QUATERNION[0]}.. has length {length[k]:.4g}; one of an orientation has 1",
        )
    return Rotation.from_quat(quaternion).as_matrix()


def _number_words(table: Table, column: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a column's words as numbers (N,) and the words; without the column all are one."""
    if column not in table.cells:
        return np.zeros(table.n_rows, int), ("1",)
    words = [str(x) for x in table.cells[column]]
    number = {word: k for k, word in enumerate(dict.fromkeys(words))}
    return np.array([number[word] for word in words], int), tuple(number)


_SMOOTH = 0.1
"""Share of the motion over two rows by which a row may be off the line between its neighbours, in a recording of a motion."""
_WINDOW_S = 0.025  # [s] to each side of a row, over which a cubic polynomial is fitted to a joint's motion
_MAX_STEPS = 3.0  # median steps between two rows of one motion
_WINDOW_ROWS = (3, 12)  # rows to each side, at least and at most


def _read_motion(table: Table, actuated: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return speed, acceleration and jerk of each joint (3, N, na), zeros if the poses do not contain them.

    A column `t` [s] gives all three if the rows are a recording of a motion, and not poses one after the other. Columns `v_J`
    give speeds, unless they hold one size only, such as 1 and -1: these are sides.
    """
    motion = _differentiate(table, q)
    if all(f"v_{joint}" in table.cells for joint in actuated):
        speed = np.column_stack([_numbers(table, f"v_{joint}") for joint in actuated])
        if len(np.unique(np.abs(speed[speed != 0]))) <= 1:
            return np.zeros_like(motion)
        motion[0] = speed
    return motion


def _differentiate(table: Table, q: np.ndarray) -> np.ndarray:
    """Return speed, acceleration and jerk (3, N, na) of a recording, zeros if the rows are not a recording."""
    motion = np.zeros((3, *q.shape))
    t = table.numbers("t", gaps=True) if "t" in table.cells else np.zeros(0)
    if not np.isfinite(t).all() or len(np.unique(t)) < max(len(q), 2 * _WINDOW_ROWS[0] + 1):
        return motion
    order = np.argsort(t)
    t, x, step = t[order], q[order], float(np.median(np.diff(t[order])))
    part = np.concatenate([[0], np.cumsum(np.diff(t) > _MAX_STEPS * step)])  # between gaps
    within = part[2:] == part[:-2]
    share, moved = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None], x[2:] - x[:-2]
    off = x[1:-1] - x[:-2] - share * moved
    if not within.any() or np.sum(off[within] ** 2) >= _SMOOTH**2 * np.sum(moved[within] ** 2):
        return motion
    half = int(np.clip(np.ceil(_WINDOW_S / step), *_WINDOW_ROWS))
    first, last = np.searchsorted(part, part), np.searchsorted(part, part, side="right") - 1
    long = np.flatnonzero(last - first >= 2 * half)
    middle = np.clip(long, first[long] + half, last[long] - half)
    near = middle[:, None] + np.arange(-half, half + 1)
    away = t[near] - t[long, None]
    size = np.abs(away).max(axis=1)[:, None]
    terms = np.linalg.pinv((away / size)[:, :, None] ** np.arange(4)) @ x[near]
    for power, factor in ((1, 1.0), (2, 2.0), (3, 6.0)):
        motion[power - 1, order[long]] = factor * terms[:, power] / size**power
    return motion


def _approach(table: Table, actuated: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return the side from which each joint came (N, na), by its speed if given, otherwise by the pose before."""
    if all(f"v_{joint}" in table.cells for joint in actuated):
        return np.sign(np.column_stack([_numbers(table, f"v_{joint}") for joint in actuated]))
    step = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    for k in range(1, len(step)):  # a joint at rest stays on the side it came from
        step[k] = np.where(step[k] == 0, step[k - 1], step[k])
    return step
