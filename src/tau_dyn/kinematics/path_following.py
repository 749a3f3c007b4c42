r"""Inverse kinematics along a path: one branch from the first sample to the last, and where it would be lost is told.

Solved pose by pose, every pose gets home's configuration, whichever way the path came. A robot that drives the path keeps
the branch that it is on: the one it stands in, or home's. It can leave it only through a singularity, where a rod stands
across what its actuator does (serial) or the rods lose hold of the plate (parallel): there a determinant of `G_q` or `G_x`
passes zero. Reference: Gosselin & Angeles 1990; Merlet 2006, ch. 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    Poses,
    Rods,
    find_nearest_configuration,
    forward_kinematics,
    get_robot,
    get_rods,
    inverse_kinematics,
    jacobian,
    require_poses,
    require_positions,
)
from tau_dyn.robot import Robot

_MAX_STEP_RATIO = 0.3  # of the mean rod's length, or m or rad without rods: no path of neighbouring poses asks for this


@dataclass(frozen=True, eq=False)
class FollowedPath:
    """A path in one branch.

    Attributes:
        q: Actuated positions (N, na), nan from the sample on that the branch does not reach.
        poses: Of the tool as reached (N), nan likewise.
        until: Number of samples reached.
        reason: Why the path ends there, '' where it does not: 'serial singularity', 'parallel singularity', 'jump' (the path
            is too coarse to tell, or the branch ends), or a reason of `outcome`.
        crossing: Where along the path a singularity would be crossed, as a sample number with its fraction; nan for none.
    """

    q: np.ndarray
    poses: Poses
    until: int
    reason: str
    crossing: float = np.nan

    @property
    def ok(self) -> np.ndarray:
        """Which samples are reached (N,)."""
        return np.arange(len(self.q)) < self.until


def follow_path(robot: Robot | Rods, path: Poses | np.ndarray, *, start: np.ndarray | None = None) -> FollowedPath:
    """Follow a path of tool poses, or of actuated positions, without leaving the branch; joint limits are not looked at.

    Args:
        robot: A robot or its rods.
        path: Poses of the tool (N), or actuated positions (N, na), each near the one before.
        start: Actuated positions (na,) at or near the first pose, which tell the branch; by default home's branch.

    Raises:
        InputError: Wrong shapes, no samples, or a start together with actuated positions.
    """
    owner, by_pose = get_robot(robot), isinstance(path, Poses)
    if start is not None and not by_pose:
        raise InputError("invalid_value", "a path of actuated positions needs no start: its first sample is one")
    asked = require_poses(path) if isinstance(path, Poses) else require_positions(owner, path)
    if not len(asked[0] if isinstance(asked, Poses) else asked):
        raise InputError("too_little_data", "a path needs at least one sample")
    if isinstance(asked, Poses):
        here = None if start is None else require_positions(owner, start)[0]
        q, poses, reason = _solved(robot, asked, here)
    else:
        found = forward_kinematics(robot, asked)
        q, poses, reason = asked, found.poses, found.reason
    lost = np.flatnonzero(reason.astype(str) != "")
    until, why = (int(lost[0]), str(reason[lost[0]])) if lost.size else (len(q), "")
    home = start is None and by_pose
    crossing, kind = _crossing(robot, q[:until], poses.take(slice(until)), home, by_pose) if until else (np.nan, "")
    if np.isfinite(crossing):
        until, why = int(np.ceil(crossing)), kind
    left = np.arange(len(q)) >= until
    position, rotation = np.array(poses.position), np.array(poses.rotation)
    position[left], rotation[left] = np.nan, np.nan
    return FollowedPath(np.where(left[:, None], np.nan, q), Poses(position, rotation), until, why, crossing)


def _solved(robot: Robot | Rods, asked: Poses, here: np.ndarray | None) -> tuple[np.ndarray, Poses, np.ndarray]:
    """Return positions, poses reached and reasons; all samples at once, and from the first jump on one after the other."""
    rods, owner = get_rods(robot), get_robot(robot)
    near = owner.home if here is None else here
    signs = None if rods is None else find_nearest_configuration(rods, asked.take(slice(1)), near)
    found = inverse_kinematics(robot, asked, configuration=signs, start=here, limits=False)
    q, rotation, reason = found.q.copy(), found.rotation.copy(), found.reason.astype(object)
    jumps = np.flatnonzero(~(_moved(robot, np.diff(q, axis=0)) < _MAX_STEP_RATIO)) + 1
    for k in range(int(jumps[0]), len(q)) if jumps.size else ():
        one = inverse_kinematics(robot, asked.take(slice(k, k + 1)), configuration=signs, start=q[k - 1], limits=False)
        q[k], rotation[k], reason[k] = one.q[0], one.rotation[0], one.reason[0]
        if one.ok[0] and not _moved(robot, q[k] - q[k - 1]) < _MAX_STEP_RATIO:
            reason[k] = "jump"
        if reason[k]:
            break
    return q, Poses(asked.position, rotation), reason


def _moved(robot: Robot | Rods, step: np.ndarray) -> np.ndarray:
    """Return the largest actuated step: slides by the rods' mean length, turns in rad without whole ones."""
    rods = get_rods(robot)
    turning = np.array([kind == "revolute" for kind in get_robot(robot).joint_kinds])
    scale = 1.0 if rods is None else float(np.mean(rods.lengths))
    turned = np.abs((step + np.pi) % (2 * np.pi) - np.pi)
    return np.max(np.where(turning, turned, np.abs(step) / scale), axis=-1)


def _crossing(robot: Robot | Rods, q: np.ndarray, poses: Poses, home: bool, serial: bool) -> tuple[float, str]:
    """Return where a determinant first passes zero, and which kind it is; nan where none does.

    Driven actuators pass a serial singularity as they please, so it counts for paths of poses only.
    """
    first, kind = np.nan, ""
    here = {
        name: rows for name, rows in _determinants(robot, q, poses).items() if serial or name.startswith("parallel")
    }
    for name, rows in here.items():
        before = rows[:1]
        if home:
            owner, rods = get_robot(robot), get_rods(robot)
            at = forward_kinematics(robot, owner.home[None]).poses if rods is None else rods.tool_poses(rods.home)
            before = _determinants(robot, owner.home[None], at)[name]
        other = np.flatnonzero((rows * before < 0).any(axis=1)) if rows.size else np.zeros(0, int)
        if other.size and not first <= other[0]:
            k, first, kind = int(other[0]), float(other[0]), name
            if k:
                column = int(np.argmax(rows[k] * before[0] < 0))
                a, b = rows[k - 1, column], rows[k, column]
                first = k - 1 + float(a / (a - b))
    return first, kind


def _determinants(robot: Robot | Rods, q: np.ndarray, poses: Poses) -> dict[str, np.ndarray]:
    """Return the numbers (N, n) that pass zero in singularities."""
    rods = get_rods(robot)
    if rods is None:
        J = jacobian(robot, q)
        square = J.shape[2] if J.shape[2] in (3, 6) else 0
        return {"serial singularity": np.linalg.det(J[:, :square])[:, None] if square else np.zeros((len(q), 0))}
    plate = rods.plate_poses(poses)
    by_q, width = rods.gap_by_q(q, plate), 3 if rods.translates else 6
    serial = []
    for own, actuators in rods.groups:
        rows = own if len(own) == len(actuators) else own[: len(actuators)]
        if len(rows) == len(actuators):
            serial.append(np.linalg.det(by_q[:, rows][:, :, actuators]))
    found = {"serial singularity": np.stack(serial, axis=1) if serial else np.zeros((len(q), 0))}
    if rods.n == width:
        found["parallel singularity"] = np.linalg.det(rods.gap_by_pose(q, plate)[:, :, :width])[:, None]
    return found
