r"""Kinematics of any tree with loops: a serial arm, a plate with joints of its own, a planar mechanism, a wrist on a plate.

Forward: the loops are closed at `q` (`loop_arrays.py`) and the tool frame is read off. Inverse: Newton on the actuated
joints with the tool's Jacobian `J = J_tree G`, orientation in the null space of position, so that a robot with fewer than
six freedoms takes the position asked for and comes as near to the orientation as it can. Reference: Siciliano et al.
2009, ch. 3.5 and 3.7.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.kinematics.loop_arrays import Closed, LoopArrays
from tau_dyn.kinematics.loops import LoopSolver
from tau_dyn.kinematics.outcome import NO_CONVERGENCE, NOT_A_NUMBER, OK, OUT_OF_REACH
from tau_dyn.kinematics.plate_arrays import log_of
from tau_dyn.kinematics.poses import Poses
from tau_dyn.kinematics.tree_arrays import cross, joints_of, motion, point, times
from tau_dyn.robot import Robot

_BLOCK = 1024
_STEP = 0.3  # [m or rad] largest actuated step of the inverse
_ROUNDS = 60
_DONE = 1e-13  # [m or rad]
_SMALL = 1e-6  # [m or rad] where a step that is cut again and again ends
_REACHED = 1e-9  # [m]
_RANK = 1e-7


class TreePose:
    """Solves one robot."""

    def __init__(self, robot: Robot) -> None:
        """Prepare for a robot with a frame `tool`.

        Raises:
            InputError: It has no tool frame, or a joint of several freedoms.
            LoopClosureError: Its loops cannot be closed at home.
        """
        if robot.tool_frame is None:
            raise InputError(
                f"{robot.source}: has no frame 'tool' whose pose could be computed; add a fixed joint 'tool'"
            )
        joints = joints_of(robot.model)
        if joints is None:
            raise InputError(f"{robot.source}: kinematics of a tree needs joints of one degree of freedom each")
        self.robot, self.joints = robot, joints
        self.loops = LoopArrays(LoopSolver(robot), joints)
        frame = robot.model.frames[robot.tool_frame]
        self._joint, self._tool = int(frame.parentJoint), frame.placement
        self._carriers = robot.model.supports[self._joint].tolist()[1:]
        self._by_index = {joint.index: joint for joint in joints}

    def forward(self, q: np.ndarray, start: Poses | None = None) -> tuple[Poses, np.ndarray]:
        """Return the tool's poses and codes at `q` (N, na), in home's assembly mode."""
        code = np.where(np.isfinite(q).all(axis=1), OK, NOT_A_NUMBER).astype(np.int8)
        position, rotation = np.full((len(q), 3), np.nan), np.full((len(q), 3, 3), np.nan)
        sound = np.flatnonzero(code == OK)
        for first in range(0, len(sound), _BLOCK):
            part = sound[first : first + _BLOCK]
            for index, closed in self.closed(q, part):
                pose = self.pose(closed)
                position[index], rotation[index] = pose.position, pose.rotation
        code[~np.isfinite(position[:, 0]) & (code == OK)] = OUT_OF_REACH
        return Poses(position, rotation), code

    def closed(self, q: np.ndarray, index: np.ndarray) -> list[tuple[np.ndarray, Closed]]:
        """Return closures of these samples; those that cannot be closed are missing."""
        try:
            return [(index, self.loops.close(q[index]))]
        except LoopClosureError:
            if len(index) == 1:
                return []
            half = len(index) // 2
            return [*self.closed(q, index[:half]), *self.closed(q, index[half:])]

    def pose(self, closed: Closed) -> Poses:
        """Return the tool's poses."""
        position = point(closed.at, self._joint, self._tool.translation)
        rotation = times(closed.at.rotation[self._joint], self._tool.rotation)
        return Poses(position.T.copy(), np.moveaxis(rotation, 2, 0).copy())

    def jacobian(self, closed: Closed) -> np.ndarray:
        """Return the tool's twist per actuated velocity (N, 6, na), linear first, in world axes at the tool's origin."""
        place = point(closed.at, self._joint, self._tool.translation)
        out = np.zeros((6, closed.G.shape[1], place.shape[1]))
        for index in self._carriers:
            joint = self._by_index[index]
            z: np.ndarray = closed.at.axis[index]
            if joint.slides:
                out[:3] += z[:, None] * closed.G[joint.v][None]
            else:
                arm: np.ndarray = place - closed.at.origin[index]
                out[:3] += cross(z, arm)[:, None] * closed.G[joint.v][None]
                out[3:] += z[:, None] * closed.G[joint.v][None]
        return out.transpose(2, 0, 1)

    def acceleration(self, closed: Closed, v: np.ndarray) -> np.ndarray:
        """Return the tool's acceleration (N, 6) at velocities `v` (N, na) without actuated acceleration."""
        rates = np.einsum("van,na->vn", closed.G, v)
        a = self.loops.accelerations(closed, rates, np.zeros((self.robot.na, len(v))))
        moving = motion(self.joints, closed.at, rates, a, np.zeros(3))
        j = self._joint
        arm = point(closed.at, j, self._tool.translation) - closed.at.origin[j]
        w, dw = moving.turning[j], moving.spinning_up[j]
        linear = np.zeros_like(arm)
        for term in (moving.acceleration[j], cross(dw, arm), cross(w, cross(w, arm))):
            linear = linear if term is None else linear + term
        angular = np.zeros_like(arm) if dw is None else dw
        return np.concatenate([linear, angular]).T

    def inverse(self, poses: Poses, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (N, na), codes, position errors and orientation errors, from starts (N, na)."""
        q, code = start.copy(), np.full(len(start), NO_CONVERGENCE, np.int8)
        errors = np.full((len(start), 2), np.nan)
        sound = np.isfinite(poses.position).all(axis=1) & np.isfinite(poses.rotation).all(axis=(1, 2))
        code[~sound] = NOT_A_NUMBER
        left, last = np.flatnonzero(sound), np.zeros_like(q)
        for _ in range(_ROUNDS):
            keep, closures = [], self.closed(q, left) if left.size else []
            for index, closed in closures:
                step, error = self._step(closed, poses.take(index))
                errors[index] = error
                done = np.abs(step).max(axis=1) < _DONE * np.maximum(1.0, np.abs(q[index]).max(axis=1))
                code[index[done]] = np.where(error[done, 0] < _REACHED, OK, OUT_OF_REACH)
                q[index] += step
                last[index] = step
                keep.append(index[~done])
            open_ = np.setdiff1d(left, np.concatenate([i for i, _ in closures])) if closures else left
            q[open_] -= 0.75 * last[open_]  # the loops do not close there: a quarter of the step
            last[open_] *= 0.25
            keep.append(open_[np.abs(last[open_]).max(axis=1, initial=0.0) > _SMALL])
            left = np.concatenate(keep)
            if not left.size:
                break
        near = (code == NO_CONVERGENCE) & (errors[:, 0] < _REACHED)
        code[near] = OK
        code[(code == NO_CONVERGENCE) & sound] = OUT_OF_REACH
        q[code != OK] = np.nan
        return q, code, errors[:, 0], errors[:, 1]

    def _step(self, closed: Closed, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Return actuated steps (N, na) and the errors of position and orientation (N, 2)."""
        at, J = self.pose(closed), self.jacobian(closed)
        away = poses.position - at.position
        turn = log_of(np.moveaxis(poses.rotation @ np.swapaxes(at.rotation, 1, 2), 0, 2)).T
        first = _inverse(J[:, :3], J[:, :3])
        step = np.einsum("nai,ni->na", first, away)
        free = np.eye(J.shape[2]) - first @ J[:, :3]
        turning = J[:, 3:] @ free
        rest = turn - np.einsum("nia,na->ni", J[:, 3:], step)
        step = step + np.einsum("nab,nbi,ni->na", free, _inverse(turning, J[:, 3:]), rest)
        size = np.abs(step).max(axis=1, keepdims=True)
        step = step * np.minimum(1.0, _STEP / np.maximum(size, 1e-300))
        return step, np.stack([np.linalg.norm(away, axis=1), np.linalg.norm(turn, axis=1)], axis=1)


def _inverse(J: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return pseudo-inverses (N, c, r) of matrices (N, r, c), without directions that are rounding beside the whole Jacobian."""
    u, s, vt = np.linalg.svd(J, full_matrices=False)
    floor = _RANK * np.linalg.norm(whole, axis=(1, 2))[:, None]
    weight = np.divide(1.0, s, out=np.zeros_like(s), where=s > floor)
    return np.swapaxes(vt, 1, 2) * weight[:, None] @ np.swapaxes(u, 1, 2)
