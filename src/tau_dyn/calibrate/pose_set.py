"""Measured poses: actuated positions and where the measuring device saw the tool, in the device's own frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.pose_columns import ANGLES, name_pose_columns, read_angles
from tau_dyn.exceptions import InputError
from tau_dyn.log import ColumnMap, Table, compute_mapped_columns, format_names, read_table
from tau_dyn.mechanism import Poses
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import Brief
from tau_dyn.robot import Mimic

POSITION = ("x_tool", "y_tool", "z_tool")
STDERRS = ("x_tool_stderr", "y_tool_stderr", "z_tool_stderr")
ROTATION_STDERR = "rot_tool_stderr"
QUATERNION = ("qx_tool", "qy_tool", "qz_tool", "qw_tool")
_MAX_JOINT_DIFFERENCE = 1e-6  # [rad or m]; encoders of a standing robot repeat far better
_MAX_COORDINATE_M = 1e3  # [m] from the device; farther is a file in mm
_MAX_ROOM_M = 50.0  # [m] from the device in most rows; farther, single far rows are no slips but all rows are in mm


def measure_spread(position: np.ndarray) -> float:
    """Return the rms distance of positions (N, 3) from their middle [m]."""
    return float(np.sqrt(np.sum(np.var(position, axis=0))))


@dataclass(frozen=True, eq=False)
class PoseSet(Brief):
    """Measured poses.

    Attributes:
        q: Actuated positions (N, na) [m or rad].
        position: Of the tool or target in the device's frame (N, 3) [m].
        rotation: Rotation matrices (N, 3, 3), None where only positions were measured.
        names: What each pose is called in messages (N,), such as `poses.csv, line 12`.
        campaign: Which measuring campaign each pose belongs to (N,), from 0; frames may have moved in between.
        campaigns: Names of the campaigns.
        target: Which target on the tool each pose was measured at (N,), from 0.
        targets: Names of the targets.
        approach: From which side each actuated joint came (N, na): +1, -1, or 0 where nobody knows.
        position_stderr: Standard errors of the measured coordinates (N, 3) [m], None where none are stated.
        rotation_stderr: Of the measured orientation about each axis (N,) [rad], None where none are stated.
        angles: Three numbers of the orientation as written (N, 3), which `rotation` takes for rotation vectors; None where four
            numbers or none are given.
        source: File, for messages.
        sha256: Hash of the file, '' where there is none.
        warnings: What was doubtful.
    """

    q: np.ndarray
    position: np.ndarray
    rotation: np.ndarray | None = None
    names: tuple[str, ...] = ()
    campaign: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    campaigns: tuple[str, ...] = ("1",)
    target: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    targets: tuple[str, ...] = ("1",)
    approach: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    position_stderr: np.ndarray | None = None
    rotation_stderr: np.ndarray | None = None
    angles: np.ndarray | None = None
    source: str = "poses"
    sha256: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Fill in what was not given and refuse what does not fit together."""
        n = len(self.q)
        if np.ndim(self.q) != 2 or np.shape(self.position) != (n, 3):
            raise InputError(
                "wrong_shape",
                f"poses need q (N, na) and positions (N, 3), not {np.shape(self.q)} and {np.shape(self.position)}",
            )
        if self.rotation is not None and np.shape(self.rotation) != (n, 3, 3):
            raise InputError("wrong_shape", f"rotations of poses must be ({n}, 3, 3), not {np.shape(self.rotation)}")
        if not self.names:
            object.__setattr__(self, "names", tuple(f"pose {k + 1}" for k in range(n)))
        if len(self.campaign) != n:
            object.__setattr__(self, "campaign", np.zeros(n, int))
        if len(self.target) != n:
            object.__setattr__(self, "target", np.zeros(n, int))
        if self.approach.shape != np.shape(self.q):
            object.__setattr__(self, "approach", np.zeros(np.shape(self.q)))

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.q)

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return self.q.shape[1]

    @property
    def spread(self) -> float:
        """Rms distance of the positions from their middle [m]."""
        return measure_spread(self.position)

    @property
    def configuration(self) -> np.ndarray:
        """Which poses have the same joint positions, such as several targets seen from one or repeats (N,), from 0.

        Numbered by the positions, so that parts drawn of them do not depend on the order of rows.
        """
        return np.unique(np.round(self.q / _MAX_JOINT_DIFFERENCE), axis=0, return_inverse=True)[1].ravel()

    @property
    def setup(self) -> np.ndarray:
        """Which device frame and which target frame each pose has (N, 2); one target may move between campaigns."""
        return np.column_stack([self.campaign, self.target if len(self.targets) > 1 else self.campaign])

    @property
    def poses(self) -> Poses:
        """Position and rotation; without measured orientation the rotations are nan."""
        rotation = np.full((self.n, 3, 3), np.nan) if self.rotation is None else self.rotation
        return Poses(self.position, rotation)

    def take(self, index: np.ndarray) -> PoseSet:
        """Return the poses at an index (n,) or a mask (N,)."""
        index = np.arange(self.n)[index]
        return replace(
            self,
            q=self.q[index],
            position=self.position[index],
            rotation=None if self.rotation is None else self.rotation[index],
            names=tuple(self.names[k] for k in index),
            campaign=self.campaign[index],
            target=self.target[index],
            approach=self.approach[index],
            position_stderr=None if self.position_stderr is None else self.position_stderr[index],
            rotation_stderr=None if self.rotation_stderr is None else self.rotation_stderr[index],
            angles=None if self.angles is None else self.angles[index],
        )

    def relative_errors(self, m: int, over: PoseSet | None = None) -> np.ndarray:
        """Return stated standard errors (N, m) over their median, position before orientation; ones where none are stated.

        Args:
            m: Numbers of a pose, 3 or 6.
            over: Poses whose medians count, such as those that a noise was estimated of; these unless given.
        """
        out, known = np.ones((self.n, m)), self if over is None else over
        if self.position_stderr is not None and known.position_stderr is not None:
            out[:, :3] = self.position_stderr / np.median(known.position_stderr)
        if self.rotation_stderr is not None and known.rotation_stderr is not None and m > 3:
            out[:, 3:] = (self.rotation_stderr / np.median(known.rotation_stderr))[:, None]
        return out

    def without_rotation(self) -> PoseSet:
        """Return the positions alone."""
        return replace(self, rotation=None)


def number_alike(poses: PoseSet, holdout: PoseSet) -> PoseSet:
    """Return held-out poses with the training poses' numbering of campaigns and targets."""
    campaign = _renumber(holdout, "campaign", holdout.campaign, holdout.campaigns, poses.campaigns)
    target = _renumber(holdout, "target", holdout.target, holdout.targets, poses.targets)
    return replace(holdout, campaign=campaign, campaigns=poses.campaigns, target=target, targets=poses.targets)


def _renumber(
    holdout: PoseSet, kind: str, number: np.ndarray, names: tuple[str, ...], known: tuple[str, ...]
) -> np.ndarray:
    """Return numbers (N,) of names as they stand among the known ones; one name alone is the same one under any name."""
    if len(known) == 1 and len(names) == 1:
        return number
    for name in names:
        if name not in known:
            raise InputError(
                "mismatch",
                f"{holdout.source}: {kind} {name} is not among the training poses' {kind}s ({', '.join(known)}), "
                "so where it is is unknown",
            )
    return np.array([known.index(name) for name in names])[number]


def join_pose_sets(sets: Sequence[PoseSet]) -> PoseSet:
    """Return the poses of several files as one set; campaigns of one name are one campaign, and so are targets.

    Raises:
        InputError: Some have orientations, others not.
    """
    if len(sets) == 1:
        return sets[0]
    turned = [s.rotation is not None for s in sets]
    if any(turned) and not all(turned):
        raise InputError(
            "mismatch",
            f"{sets[turned.index(False)].source} has no orientations, {sets[turned.index(True)].source} has; give poses alike",
        )
    campaign, campaigns = _join_words([(s.campaign, s.campaigns) for s in sets])
    target, targets = _join_words([(s.target, s.targets) for s in sets])
    return PoseSet(
        q=np.concatenate([s.q for s in sets]),
        position=np.concatenate([s.position for s in sets]),
        rotation=np.concatenate([s.rotation for s in sets if s.rotation is not None]) if all(turned) else None,
        names=tuple(name for s in sets for name in s.names),
        campaign=campaign,
        campaigns=campaigns,
        target=target,
        targets=targets,
        approach=np.concatenate([s.approach for s in sets]),
        position_stderr=_join_stated([s.position_stderr for s in sets]),
        rotation_stderr=_join_stated([s.rotation_stderr for s in sets]),
        angles=_join_stated([s.angles for s in sets]),
        source=", ".join(s.source for s in sets),
        warnings=tuple(w for s in sets for w in s.warnings),
    )


def _join_words(parts: Sequence[tuple[np.ndarray, tuple[str, ...]]]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return one numbering of names that several files number each for itself, and the names."""
    names = tuple(dict.fromkeys(name for _, words in parts for name in words))
    return np.concatenate([np.array([names.index(name) for name in words])[number] for number, words in parts]), names


def _join_stated(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return the standard errors of several files; None unless all state them."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def read_poses(
    path: str | Path,
    actuated: Sequence[str],
    *,
    columns: ColumnMap | str | Path | None = None,
    mimics: Mapping[str, Mimic] | None = None,
) -> PoseSet:
    """Read measured poses from CSV or Parquet, with the columns `q_J`, `x_tool y_tool z_tool` and maybe `qx_tool` .. `qw_tool`.

    Without a quaternion `rx_tool ry_tool rz_tool` are a rotation vector or three angles; other usual names are read, with a
    warning (`pose_columns.py`). `x_tool_stderr` .. `z_tool_stderr` [m] and `rot_tool_stderr` [rad] are standard errors that
    weigh the poses; a zero counts as the smallest of its column above zero. A column `campaign` tells measuring campaigns apart,
    a column `target` the targets on the tool; the signs of `v_J` tell from which side a joint came, and without them the order
    of the file does.

    Args:
        path: File.
        actuated: Actuated joints of the robot, in its order.
        columns: Map for foreign columns, or the path of one; its `couplings` undo coupled transmissions.
        mimics: Joints that follow others in the robot file; a column that they lack is computed.

    Raises:
        InputError: Columns are missing, cells are no numbers, or quaternions no orientations.
    """
    table = read_table(path)
    if columns is not None:
        table = _rename_columns(table, columns if isinstance(columns, ColumnMap) else ColumnMap.load(columns))
    table = _follow_mimics(table, mimics or {})
    table = name_pose_columns(table, actuated)
    _check_columns(table, actuated)
    q = np.column_stack([_numbers(table, f"q_{joint}") for joint in actuated])
    position = np.column_stack([_numbers(table, name) for name in POSITION])
    campaign, campaigns = _number_words(table, "campaign")
    target, targets = _number_words(table, "target")
    (stated, said), (turned, more) = _read_stated(table, STDERRS), _read_stated(table, (ROTATION_STDERR,))
    rotation, angles, how = read_angles(table) if _has_angles(table) else (_rotations(table), None, "")
    poses = PoseSet(
        q=q,
        position=position,
        rotation=rotation,
        names=tuple(table.where(k) for k in range(table.n_rows)),
        campaign=campaign,
        campaigns=campaigns,
        target=target,
        targets=targets,
        approach=_approach(table, actuated, q),
        position_stderr=stated,
        rotation_stderr=None if turned is None else turned[:, 0],
        angles=angles,
        source=table.name,
        sha256=table.sha256,
        warnings=(
            *table.warnings,
            *([CodedWarning("columns_read", f"{table.name}: {how}")] if how else []),
            *said,
            *more,
        ),
    )
    if np.median(np.abs(position).max(axis=1)) < _MAX_ROOM_M:  # else the whole file has another unit
        check_units(poses)
    return poses


def _rename_columns(table: Table, map_: ColumnMap) -> Table:
    """Return the table with the map's columns in our names and units beside its others.

    Raises:
        InputError: The map reads further files.
    """
    if map_.files:
        raise InputError("unsupported", f"{map_.name}: poses stand in one file; leave out files")
    return replace(table, cells={**table.cells, **compute_mapped_columns({None: table}, map_)})


def _follow_mimics(table: Table, mimics: Mapping[str, Mimic]) -> Table:
    """Return the table with the positions of joints that follow others, where it lacks them."""
    cells = dict(table.cells)
    for _ in mimics:  # a joint may follow one that follows another
        for joint, mimic in mimics.items():
            if f"q_{joint}" not in cells and f"q_{mimic.joint}" in cells:
                known = replace(table, cells=cells).numbers(f"q_{mimic.joint}")
                cells[f"q_{joint}"] = mimic.multiplier * known + mimic.offset
    return replace(table, cells=cells)


def _check_columns(table: Table, actuated: Sequence[str]) -> None:
    wanted = [*(f"q_{joint}" for joint in actuated), *POSITION]
    missing = [name for name in wanted if name not in table.cells]
    if missing:
        raise InputError(
            "missing_column",
            f"{table.name} has no column {format_names(missing)}; calibration poses need {format_names(wanted)} "
            f"and, where the orientation "
            f"was measured, {format_names(QUATERNION)}, or a rotation vector or Euler angles {format_names(ANGLES)}; "
            f"it has {format_names(table.cells)}",
        )
    some = [name for name in QUATERNION if name in table.cells]
    if some and len(some) < 4:
        lacking = [name for name in QUATERNION if name not in some]
        raise InputError(
            "file_format",
            f"{table.name} has {format_names(some)} but not {format_names(lacking)}; a quaternion needs all four",
        )


def _read_stated(table: Table, names: Sequence[str]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return standard errors (N, k) from the table, None where it has none, and a warning of zeros.

    A zero is a scatter below the last digit that was written: it counts as the smallest one above zero in its column.

    Raises:
        InputError: Some columns are missing, a standard error is below zero, or a column has none above zero.
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
    """Refuse positions that no device measures in m.

    Raises:
        InputError: Names the farthest pose.
    """
    far = np.abs(poses.position).max(axis=1)
    if np.any(far > _MAX_COORDINATE_M):
        k = int(np.argmax(far))
        raise InputError(
            "wrong_unit", f"{poses.names[k]}: the tool is {far[k]:.0f} m from the device; positions are in m, not in mm"
        )


def _has_angles(table: Table) -> bool:
    """Tell whether orientations are three numbers; a quaternion goes first."""
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


def _approach(table: Table, actuated: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return from which side each joint came (N, na), by its speed where it is given, else by the pose before."""
    if all(f"v_{joint}" in table.cells for joint in actuated):
        return np.sign(np.column_stack([_numbers(table, f"v_{joint}") for joint in actuated]))
    step = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    for k in range(1, len(step)):  # a joint that stands still stays on the side it came from
        step[k] = np.where(step[k] == 0, step[k - 1], step[k])
    return step
