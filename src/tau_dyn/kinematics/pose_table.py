"""Tables of actuated positions and tool poses: reading of columns of a file, and the results of `fk` and `ik`, row by row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly import list_robot_modes
from tau_dyn.mechanism import (
    JOINT_LIMIT,
    NOT_A_NUMBER,
    OK,
    OUT_OF_REACH,
    REASONS,
    InverseResult,
    Poses,
    build_kinematics,
    convert_from_quaternions,
    convert_to_quaternions,
    forward_kinematics,
    inverse_kinematics,
)
from tau_dyn.results import Shown
from tau_dyn.robot import Robot

TOOL = ("x_tool", "y_tool", "z_tool", "qx_tool", "qy_tool", "qz_tool", "qw_tool")


def read_positions(columns: dict[str, np.ndarray], robot: Robot, where: str) -> np.ndarray:
    """Return actuated positions (N, na) from a table's columns `q_<joint>`."""
    return pick_columns(columns, [f"q_{joint}" for joint in robot.actuated], where)


def read_poses(columns: dict[str, np.ndarray], robot: Robot, where: str) -> Poses:
    """Return tool poses from a table's columns `x_tool`..; without a quaternion the orientation is home's."""
    position = pick_columns(columns, list(TOOL[:3]), where)
    if not any(name in columns for name in TOOL[3:]):
        return place_home_orientation(robot, position)
    return convert_from_quaternions(position, pick_columns(columns, list(TOOL[3:]), where))


def place_home_orientation(robot: Robot, position: np.ndarray) -> Poses:
    """Return poses at positions (N, 3) [m] with home's orientation."""
    home = forward_kinematics(robot, robot.home[None]).poses.rotation[0]
    return Poses(position, np.repeat(home[None], len(position), axis=0))


def pick_columns(columns: dict[str, np.ndarray], names: list[str], where: str) -> np.ndarray:
    """Return columns of a table, side by side (N, n), as numbers.

    Raises:
        InputError: A column is missing, or holds text.
    """
    for name in names:
        if name not in columns:
            raise InputError("missing_column", f"{where}: no column '{name}'; there are {', '.join(columns)}")
    return np.stack([_numbers(columns[name], f"{where}: column '{name}'") for name in names], axis=1)


def _numbers(cells: np.ndarray, where: str) -> np.ndarray:
    """Return cells as numbers, empty ones as nan."""
    if cells.dtype.kind in "fiu":
        return cells.astype(float)
    texts = [str(cell).strip() for cell in cells]
    try:
        return np.array([float(text) if text else np.nan for text in texts])
    except ValueError as fault:
        raise InputError("bad_sample", f"{where} must hold numbers; {fault}") from fault


_MAX_REACH_M = 50.0  # [m] larger than any robot; positions in millimetres exceed it
_TOLD = 1e-6  # [rad] orientation errors below this are rounding


class Count(NamedTuple):
    """How many assembly modes or inverse solutions a row of the input has: found, whether it is proved to be all, and why."""

    pose: int
    count: int
    proved: bool
    why: str


@dataclass(frozen=True, eq=False)
class PoseTable(Shown):
    """Rows of positions and poses.

    Attributes:
        robot: The robot.
        inverse: Whether poses were given (`ik`) or positions (`fk`).
        pose: Row of the input, from 1 (N,).
        q: Actuated positions (N, na), nan in rows without an answer.
        position: Position of the tool (N, 3) [m].
        quaternion: Orientation of the tool (N, 4), x y z w.
        reason: Reason why a row has no answer, '' if it has one (N,).
        configuration: Name of the configuration (`ik`) or of the assembly mode (`fk`), '' if not requested (N,).
        warnings: Sentences.
        counts: Number of modes or configurations of each row of the input; empty if not requested.
    """

    robot: Robot
    inverse: bool
    pose: np.ndarray
    q: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    reason: np.ndarray
    configuration: np.ndarray
    warnings: tuple[str, ...]
    counts: tuple[Count, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every configuration or mode is listed for certain."""
        return bool(self.counts) and all(count.proved for count in self.counts)

    @property
    def choice(self) -> str:
        """Name of the column that holds `configuration`: `configuration` or `mode`."""
        return "configuration" if self.inverse else "mode"

    @property
    def ok(self) -> np.ndarray:
        """Rows with an answer (N,)."""
        return self.reason == ""

    def columns(self) -> dict[str, np.ndarray]:
        """Return the table's columns by name, with the names used in logs."""
        table: dict[str, np.ndarray] = {}
        if self.configuration.any():
            table |= {"pose": self.pose, self.choice: self.configuration}
        table |= {f"q_{joint}": self.q[:, k] for k, joint in enumerate(self.robot.actuated)}
        table |= {name: self.position[:, k] for k, name in enumerate(TOOL[:3])}
        table |= {name: self.quaternion[:, k] for k, name in enumerate(TOOL[3:])}
        return table | {"reason": self.reason}

    def to_csv(self) -> str:
        """Return the table as CSV; a number that does not exist is an empty cell."""
        import pandas as pd

        return pd.DataFrame(self.columns()).to_csv(index=False, float_format="%.17g", lineterminator="\n")

    def to_dict(self) -> dict[str, Any]:
        """Return the table for `--json`."""
        rows = [
            {
                "pose": int(self.pose[k]),
                "configuration": (self.configuration[k] or None) if self.inverse else None,
                "mode": None if self.inverse else self.configuration[k] or None,
                "q": self.q[k],
                "position": self.position[k],
                "quaternion": self.quaternion[k],
                "reason": self.reason[k] or None,
            }
            for k in range(len(self.q))
        ]
        return {
            "robot": self.robot.name,
            "joints": list(self.robot.actuated),
            "units": list(self.robot.position_units),
            "answered": int(self.ok.sum()),
            "rows": rows,
            "solutions" if self.inverse else "modes": [count._asdict() for count in self.counts],
        }


def build_forward_table(
    robot: Robot, q: np.ndarray, *, all_modes: bool = False, progress: Callable[[str], None] = lambda step: None
) -> PoseTable:
    """Return the tool's poses at positions (N, na), in home's assembly mode or in all modes that are found.

    Raises:
        InputError: No position has a pose.
    """
    beyond = (q < robot.lower - 1e-9) | (q > robot.upper + 1e-9)
    warnings = [
        f"{robot.actuated[k]} is outside its limits {robot.lower[k]:.6g} .. {robot.upper[k]:.6g} {robot.position_units[k]} "
        f"in {int(beyond[:, k].sum())} of {len(q)} rows"
        for k in np.flatnonzero(beyond.any(axis=0))
    ]
    found = forward_kinematics(robot, q)
    if all_modes:
        table = _all_modes(robot, q, found.reason, warnings, progress)
    else:
        table = _table(robot, False, q, found.poses, found.reason, warnings=[*warnings, *_lost(found.reason)])
    if not table.ok.any():
        raise InputError(
            "unreachable", f"{robot.source}: no pose at {_listed(robot, q[0])}: {found.reason[0]}{_row(q)}"
        )
    return table


def _all_modes(
    robot: Robot, q: np.ndarray, reason: np.ndarray, warnings: list[str], progress: Callable[[str], None]
) -> PoseTable:
    """Return every assembly mode of each row; a row without a mode keeps the reason why home's mode does not exist."""
    parts, names, which, why, counts = [], [], [], [], []
    for k, row in enumerate(q):
        progress(f"assembly modes of row {k + 1} of {len(q)}")
        if not np.isfinite(row).all():
            modes, tool = None, None
            counts.append(Count(k + 1, 0, False, REASONS[NOT_A_NUMBER]))
        else:
            modes = list_robot_modes(robot, row)
            tool = modes.tool
            counts.append(Count(k + 1, tool.n_samples, modes.proved, modes.why))
        if modes is None or tool is None or not tool.n_samples:
            parts.append(Poses(np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan)))
            names, why = [*names, ""], [*why, reason[k] or REASONS[OUT_OF_REACH]]
        else:
            parts.append(tool)
            names, why = [*names, *modes.names], [*why, *[""] * tool.n_samples]
        which += [k] * parts[-1].n_samples
    pose, lost = np.array(which, int), _lost(np.array([reason[c.pose - 1] if not c.count else "" for c in counts]))
    table = _table(
        robot,
        False,
        q[pose],
        Poses.join(parts),
        np.array(why),
        pose=pose,
        configuration=np.array(names),
        warnings=[*warnings, *lost],
    )
    return replace(table, counts=tuple(counts))


def build_inverse_table(robot: Robot, poses: Poses, *, all_configurations: bool = False) -> PoseTable:
    """Return the positions for poses of the tool, in home's configuration or in all.

    Raises:
        InputError: No pose can be reached.
    """
    if all_configurations:
        return _all(robot, poses)
    found = inverse_kinematics(robot, poses)
    if not found.ok.any():
        raise InputError(
            "unreachable",
            f"{robot.source}: {_place(poses)} cannot be reached: {_why(robot, found)}{_row(poses.position)}{_millimetres(poses)}",
        )
    warnings = _lost(found.reason)
    turned = found.ok & (found.orientation_error > _TOLD)
    if turned.any():
        most = np.degrees(np.nanmax(found.orientation_error))
        warnings.append(
            f"{robot.na} actuators cannot take every orientation: {int(turned.sum())} of {len(turned)} poses are met in "
            f"position only, their orientation is off by up to {most:.4g} deg"
        )
    return _table(robot, True, found.q, poses, found.reason, warnings=warnings)


def _all(robot: Robot, poses: Poses) -> PoseTable:
    kinematics = build_kinematics(robot)
    solved = kinematics.solutions(poses)
    found = solved.q
    listed = [] if kinematics.legs is None else kinematics.configurations
    names = ["".join("0+-"[int(sign)] for sign in signs) for signs in listed]
    names = names if len(names) == found.shape[1] else [str(k + 1) for k in range(found.shape[1])]
    n, m = found.shape[:2]
    q, pose, name = found.reshape(n * m, -1), np.repeat(np.arange(n), m), np.array(names * n)
    there = np.isfinite(q).all(axis=1)
    if not there.any():
        raise InputError(
            "unreachable",
            f"{robot.source}: {_place(poses)} cannot be reached in any configuration{_row(poses.position)}",
        )
    q, pose, name = q[there], pose[there], name[there]
    beyond = ((q < robot.lower - 1e-9) | (q > robot.upper + 1e-9)).any(axis=1)
    reason = np.where(beyond, REASONS[JOINT_LIMIT], REASONS[OK])
    missing = n - len(np.unique(pose))
    warnings = [f"{missing} of {n} poses cannot be reached in any configuration"] if missing else []
    table = _table(robot, True, q, poses.take(pose), reason, pose=pose, configuration=name, warnings=warnings)
    counts = np.bincount(pose, minlength=n).tolist()
    each = zip(range(1, n + 1), counts, solved.proved.tolist(), solved.why, strict=True)
    return replace(table, counts=tuple(Count(*row) for row in each))


def _table(
    robot: Robot,
    inverse: bool,
    q: np.ndarray,
    poses: Poses,
    reason: np.ndarray,
    *,
    pose: np.ndarray | None = None,
    configuration: np.ndarray | None = None,
    warnings: list[str],
) -> PoseTable:
    numbers = np.arange(len(q)) if pose is None else pose
    names = np.full(len(q), "") if configuration is None else configuration
    position, quaternion = poses.position, convert_to_quaternions(poses)
    return PoseTable(robot, inverse, numbers + 1, q, position, quaternion, reason, names, tuple(warnings))


def _lost(reason: np.ndarray) -> list[str]:
    lost = reason != ""
    if not lost.any():
        return []
    kinds = ", ".join(f"{int(np.sum(reason == kind))} {kind}" for kind in dict.fromkeys(reason[lost].tolist()))
    return [
        f"{int(lost.sum())} of {len(reason)} rows have no answer ({kinds}); the first is row {int(np.argmax(lost)) + 1}"
    ]


def _why(robot: Robot, found: InverseResult) -> str:
    names = found.culprit[0].split()
    if found.reason[0] == REASONS[JOINT_LIMIT]:
        rows = []
        for name in names:
            k = robot.actuated.index(name)
            unit, value = robot.position_units[k], found.unlimited[0, k]
            rows.append(
                f"{name} would be at {value:.6g} {unit}, its limits are {robot.lower[k]:.6g} .. {robot.upper[k]:.6g}"
            )
        return f"joint limit: {'; '.join(rows)}"
    return f"{found.reason[0]}{' of ' + ', '.join(names) if names and len(names) < robot.na else ''}"


def _place(poses: Poses) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in poses.position[0]) + ") m"


def _millimetres(poses: Poses) -> str:
    return "; positions are in m (are they in mm?)" if np.abs(poses.position[0]).max() > _MAX_REACH_M else ""


def _listed(robot: Robot, q: np.ndarray) -> str:
    rows = zip(robot.actuated, q, robot.position_units, strict=True)
    return ", ".join(f"{joint} = {x:.6g} {unit}" for joint, x, unit in rows)


def _row(rows: np.ndarray) -> str:
    return f", and so with all {len(rows)} rows" if len(rows) > 1 else ""
