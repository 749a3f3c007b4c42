r"""Kinematics of any tree with loops: a serial arm, a plate with joints of its own, a planar mechanism, a wrist on a plate.

The loops are closed at `q` (`loop_arrays.py`) and the tool frame is read off; its Jacobian is `J_tree G`. The inverse is
`tree_newton.py`. Reference: Siciliano et al. 2009, ch. 3.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.mechanism.kinematics_result import NOT_A_NUMBER, OK, OUT_OF_REACH
from tau_dyn.mechanism.loop_arrays import ClosedLoops, LoopArrays
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.mechanism.poses import Poses
from tau_dyn.mechanism.tree_arrays import (
    Frames,
    compute_cross_product,
    compute_frames,
    compute_motion,
    list_joints,
    multiply_by_rotation,
    transform_point,
)
from tau_dyn.robot import Robot

_BLOCK = 1024  # samples at a time; arrays stay in the processor's cache


class TreePose:
    """Solves one robot."""

    def __init__(self, robot: Robot) -> None:
        """Prepare for a robot with a tool frame.

        Raises:
            InputError: It has no tool frame, or a joint of several freedoms.
            LoopClosureError: Its loops cannot be closed at home.
        """
        if robot.tool_frame is None:
            raise InputError(
                "unsupported",
                f"{robot.source}: has no evident tool frame whose pose could be computed; name one with --tool FRAME "
                '(load_robot(..., tool="FRAME"))',
            )
        joints = list_joints(robot.model)
        if joints is None:
            raise InputError(
                "unsupported", f"{robot.source}: kinematics of a tree needs joints of one degree of freedom each"
            )
        self.robot, self.joints = robot, joints
        self.loops = LoopArrays(LoopSolver(robot), joints)
        frame = robot.model.frames[robot.tool_frame]
        self._joint, self.tool = int(frame.parentJoint), frame.placement
        carrying = robot.model.supports[self._joint].tolist()[1:]
        self.carriers = [joint for joint in joints if joint.index in carrying]

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

    def closed(self, q: np.ndarray, index: np.ndarray) -> list[tuple[np.ndarray, ClosedLoops]]:
        """Return closures of these samples; those that cannot be closed are missing."""
        try:
            return [(index, self.loops.close(q[index]))]
        except LoopClosureError:
            if len(index) == 1:
                return []
            half = len(index) // 2
            return [*self.closed(q, index[:half]), *self.closed(q, index[half:])]

    def full_positions(self, q: np.ndarray) -> np.ndarray:
        """Return all joints' positions (N, nv) at actuated ones (N, na); nan where the loops cannot be closed."""
        rows, which = np.unique(q, axis=0, return_inverse=True)
        x = np.full((len(rows), self.robot.model.nv), np.nan)
        for index, closed in self.closed(rows, np.flatnonzero(np.isfinite(rows).all(axis=1))):
            x[index] = closed.x.T
        return x[which.ravel()]

    def pose(self, closed: ClosedLoops) -> Poses:
        """Return the tool's poses."""
        return self.pose_of(closed.at)

    def pose_of(self, at: Frames) -> Poses:
        """Return the tool's poses where the joints are."""
        rotation = multiply_by_rotation(at.rotation[self._joint], self.tool.rotation)
        return Poses(self.place_of(at).T.copy(), np.moveaxis(rotation, 2, 0).copy())

    def pose_at(self, x: np.ndarray) -> Poses:
        """Return the tool's poses at all joints' positions (nv, N)."""
        return self.pose_of(compute_frames(self.joints, x))

    def place_of(self, at: Frames) -> np.ndarray:
        """Return the tool's positions (3, N) [m]."""
        return transform_point(at, self._joint, self.tool.translation)

    def jacobian(self, closed: ClosedLoops) -> np.ndarray:
        """Return the tool's twist per actuated velocity (N, 6, na), linear first, in world axes at the tool's origin."""
        place = self.place_of(closed.at)
        out = np.zeros((6, closed.G.shape[1], place.shape[1]))
        for joint in self.carriers:
            z: np.ndarray = closed.at.axis[joint.index]
            if joint.slides:
                out[:3] += z[:, None] * closed.G[joint.v][None]
            else:
                arm: np.ndarray = place - closed.at.origin[joint.index]
                out[:3] += compute_cross_product(z, arm)[:, None] * closed.G[joint.v][None]
                out[3:] += z[:, None] * closed.G[joint.v][None]
        return out.transpose(2, 0, 1)

    def acceleration(self, closed: ClosedLoops, v: np.ndarray) -> np.ndarray:
        """Return the tool's acceleration (N, 6) at velocities `v` (N, na) without actuated acceleration."""
        rates = np.einsum("van,na->vn", closed.G, v)
        a = self.loops.accelerations(closed, rates, np.zeros((self.robot.na, len(v))))
        moving = compute_motion(self.joints, closed.at, rates, a, np.zeros(3))
        j = self._joint
        arm = transform_point(closed.at, j, self.tool.translation) - closed.at.origin[j]
        w, dw = moving.turning[j], moving.spinning_up[j]
        linear = np.zeros_like(arm)
        for term in (
            moving.acceleration[j],
            compute_cross_product(dw, arm),
            compute_cross_product(w, compute_cross_product(w, arm)),
        ):
            linear = linear if term is None else linear + term
        angular = np.zeros_like(arm) if dw is None else dw
        return np.concatenate([linear, angular]).T
