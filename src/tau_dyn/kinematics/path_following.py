r"""Inverse kinematics along a path in one branch; if the branch is lost, the result names the sample and the reason.

If each pose is solved separately, every pose gets home's configuration, independent of the path. A robot that drives the path
stays in its branch: the one of its start, or home's. It can leave the branch only through a singularity, at which a rod is
orthogonal to the motion of its actuator (serial) or the rods do not constrain the plate (parallel): there a determinant of `G_q`
or `G_x` passes zero. Reference: Gosselin & Angeles 1990; Merlet 2006, ch. 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Kinematics, Poses, build_kinematics, require_poses, require_positions
from tau_dyn.robot import Robot

_MAX_STEP_RATIO = 0.3  # of the mean rod's length, or m or rad without rods; neighbouring poses need less


@dataclass(frozen=True, eq=False)
class FollowedPath:
    """A path in one branch.

    Attributes:
        q: Actuated positions (N, na), nan from the first sample that the branch does not reach.
        poses: Poses reached by the tool (N), nan from the same sample.
        until: Number of samples reached.
        reason: Reason why the path ends there, '' if it does not: 'serial singularity', 'parallel singularity', 'jump' (the path
            is too coarse for a decision, or the branch ends), or a reason of the pose solver.
        crossing: Position along the path at which a singularity would be crossed, as a sample number with a fraction; nan
            without a crossing.
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


def follow_path(
    robot: Robot | Kinematics, path: Poses | np.ndarray, *, start: np.ndarray | None = None
) -> FollowedPath:
    """Follow a path of tool poses, or of actuated positions, without leaving the branch; joint limits are ignored.

    Args:
        robot: A robot or its kinematics.
        path: Poses of the tool (N), or actuated positions (N, na), each near the one before.
        start: Actuated positions (na,) at or near the first pose, which select the branch; home's branch by default.

    Raises:
        InputError: Wrong shapes, no samples, or a start together with actuated positions.
    """
    kinematics, by_pose = build_kinematics(robot), isinstance(path, Poses)
    if start is not None and not by_pose:
        raise InputError("invalid_value", "a path of actuated positions needs no start: its first sample is one")
    asked = require_poses(path) if isinstance(path, Poses) else require_positions(kinematics.robot, path)
    if not len(asked[0] if isinstance(asked, Poses) else asked):
        raise InputError("too_little_data", "a path needs at least one sample")
    if isinstance(asked, Poses):
        here = None if start is None else require_positions(kinematics.robot, start)[0]
        q, poses, reason = _solved(kinematics, asked, here)
    else:
        found = kinematics.forward(asked)
        q, poses, reason = asked, found.poses, found.reason
    lost = np.flatnonzero(reason.astype(str) != "")
    until, why = (int(lost[0]), str(reason[lost[0]])) if lost.size else (len(q), "")
    home = start is None and by_pose
    crossing, kind = (
        _crossing(kinematics, q[:until], poses.take(slice(until)), home, by_pose) if until else (np.nan, "")
    )
    if np.isfinite(crossing):
        until, why = int(np.ceil(crossing)), kind
    left = np.arange(len(q)) >= until
    position, rotation = np.array(poses.position), np.array(poses.rotation)
    position[left], rotation[left] = np.nan, np.nan
    return FollowedPath(np.where(left[:, None], np.nan, q), Poses(position, rotation), until, why, crossing)


def _solved(kinematics: Kinematics, asked: Poses, here: np.ndarray | None) -> tuple[np.ndarray, Poses, np.ndarray]:
    """Return positions, poses reached and reasons; all samples are solved at once, those after the first jump one by one."""
    near = kinematics.robot.home if here is None else here
    signs = None if kinematics.legs is None else kinematics.nearest_configuration(asked.take(slice(1)), near)
    found = kinematics.inverse(asked, configuration=signs, start=here, limits=False)
    q, rotation, reason = found.q.copy(), found.rotation.copy(), found.reason.astype(object)
    jumps = np.flatnonzero(~(_moved(kinematics, np.diff(q, axis=0)) < _MAX_STEP_RATIO)) + 1
    for k in range(int(jumps[0]), len(q)) if jumps.size else ():
        one = kinematics.inverse(asked.take(slice(k, k + 1)), configuration=signs, start=q[k - 1], limits=False)
        q[k], rotation[k], reason[k] = one.q[0], one.rotation[0], one.reason[0]
        if one.ok[0] and not _moved(kinematics, q[k] - q[k - 1]) < _MAX_STEP_RATIO:
            reason[k] = "jump"
        if reason[k]:
            break
    return q, Poses(asked.position, rotation), reason


def _moved(kinematics: Kinematics, step: np.ndarray) -> np.ndarray:
    """Return the largest actuated step: slides relative to the legs' mean length, turns in rad without whole turns."""
    turning = np.array([kind == "revolute" for kind in kinematics.robot.joint_kinds])
    scale = 1.0 if kinematics.legs is None else float(np.mean(kinematics.legs.lengths))
    turned = np.abs((step + np.pi) % (2 * np.pi) - np.pi)
    return np.max(np.where(turning, turned, np.abs(step) / scale), axis=-1)


def _crossing(kinematics: Kinematics, q: np.ndarray, poses: Poses, home: bool, serial: bool) -> tuple[float, str]:
    """Return where a determinant first passes zero, and the kind of singularity; nan if no determinant does.

    Actuators that are driven can pass a serial singularity, so it counts for paths of poses only.
    """
    first, kind = np.nan, ""
    at_home = _determinants(kinematics, kinematics.robot.home[None], kinematics.commanded.home) if home else {}
    for name, rows in _determinants(kinematics, q, poses).items():
        if not (serial or name.startswith("parallel")):
            continue
        before = at_home.get(name, rows[:1])
        other = np.flatnonzero((rows * before < 0).any(axis=1)) if rows.size else np.zeros(0, int)
        if other.size and not first <= other[0]:
            k, first, kind = int(other[0]), float(other[0]), name
            if k:
                column = int(np.argmax(rows[k] * before[0] < 0))
                a, b = rows[k - 1, column], rows[k, column]
                first = k - 1 + float(a / (a - b))
    return first, kind


def _determinants(kinematics: Kinematics, q: np.ndarray, poses: Poses) -> dict[str, np.ndarray]:
    """Return the numbers (N, n) that pass zero in singularities."""
    by_q, legs = kinematics.closure_by_q(q, poses), kinematics.legs
    if legs is None:
        square = by_q.shape[2] if by_q.shape[2] in (3, 6) else 0
        return {"serial singularity": np.linalg.det(by_q[:, :square])[:, None] if square else np.zeros((len(q), 0))}
    serial = []
    for own, actuators in legs.groups:
        rows = own if len(own) == len(actuators) else own[: len(actuators)]
        if len(rows) == len(actuators):
            serial.append(np.linalg.det(by_q[:, rows][:, :, actuators]))
    found = {"serial singularity": np.stack(serial, axis=1) if serial else np.zeros((len(q), 0))}
    by_pose = kinematics.closure_by_pose(q, poses)
    if by_pose.shape[1] == by_pose.shape[2]:
        found["parallel singularity"] = np.linalg.det(by_pose)[:, None]
    return found
