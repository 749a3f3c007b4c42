"""The tool of any tree with loops, and Newton on all joints at once: loops and tool closed, orientation as close as possible.

The loops are closed at `q` (`loop_arrays.py`) and the tool frame is read off; its Jacobian is `J_tree G`. The inverse solves

    J_loops dx = -c,   J_p dx = p_wanted - p,   minimise |J_r dx - log(R_wanted R')|

with `x` the positions of all joints, actuated and passive. No loop is closed separately during the iteration, so a pose out of
reach takes no longer than one in reach: its gap stops shrinking and it is given up. Actuators that can move without the tool
move towards the start. The cost of motion falls with the square of the remaining rotation, which keeps convergence quadratic
near singularities such as a straight elbow. Arrays of joints have samples last. Reference: Siciliano et al. 2009, ch. 3;
Yamashita & Fukushima 2001.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.mechanism.frames import (
    Frames,
    compute_frames,
    compute_motion,
    compute_point_acceleration,
    list_joints,
    multiply_by_rotation,
    remove_rounding,
    transform_point,
    yield_columns,
)
from tau_dyn.mechanism.loop_arrays import ClosedLoops, LoopArrays
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.mechanism.poses import NOT_A_NUMBER, OK, OUT_OF_REACH, Poses, StraightWay, measure_turns
from tau_dyn.mechanism.small_systems import Move, NewtonRules, iterate_newton, solve_least_motion_step
from tau_dyn.robot import Robot, read_annotations

_BLOCK = 1024  # samples at a time; arrays stay in the processor's cache


_MAX_LISTED = 8  # frames that a sentence names


def list_leaves(robot: Robot) -> str:
    """Return the links at the ends of a robot's branches, the first of many."""
    leaves = read_annotations(robot.urdf, robot.source).leaves
    return ", ".join(leaves[:_MAX_LISTED]) + (" ..." if len(leaves) > _MAX_LISTED else "")


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
                f'(load_robot(..., tool="FRAME")), such as {list_leaves(robot)}',
            )
        joints = list_joints(robot.model)
        if joints is None:
            raise InputError(
                "unsupported",
                f"{robot.source}: kinematics of a tree needs joints of one degree of freedom each; hold the others "
                "still (--hold JOINT=0, or type='fixed' in the file)",
            )
        self.robot, self.joints = robot, joints
        self.loops = LoopArrays(LoopSolver(robot), joints)
        frame = robot.model.frames[robot.tool_frame]
        self._joint, self.tool = int(frame.parentJoint), frame.placement
        self._turn, self._local = (remove_rounding(x) for x in (self.tool.rotation, self.tool.translation))
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
        rotation = multiply_by_rotation(at.rotation[self._joint], self._turn)
        return Poses(self.place_of(at).T.copy(), np.moveaxis(rotation, 2, 0).copy())

    def pose_at(self, x: np.ndarray) -> Poses:
        """Return the tool's poses at all joints' positions (nv, N)."""
        return self.pose_of(compute_frames(self.joints, x))

    def place_of(self, at: Frames) -> np.ndarray:
        """Return the tool's positions (3, N) [m]."""
        return transform_point(at, self._joint, self._local)

    def twist(self, at: Frames) -> np.ndarray:
        """Return the tool's twist by all joints (N, 6, nv)."""
        place = self.place_of(at)
        out = np.zeros_like(place, shape=(place.shape[1], 6, self.robot.model.nv))
        for joint, linear, angular in yield_columns(at, self.carriers, place):
            out[:, :3, joint.v] = linear.T
            if angular is not None:
                out[:, 3:, joint.v] = angular.T
        return out

    def jacobian(self, closed: ClosedLoops) -> np.ndarray:
        """Return the tool's twist per actuated velocity (N, 6, na), linear first, in world axes at the tool's origin."""
        place = self.place_of(closed.at)
        out = np.zeros((6, closed.G.shape[1], place.shape[1]))
        for joint, linear, angular in yield_columns(closed.at, self.carriers, place):
            out[:3] += linear[:, None] * closed.G[joint.v][None]
            if angular is not None:
                out[3:] += angular[:, None] * closed.G[joint.v][None]
        return out.transpose(2, 0, 1)

    def acceleration(self, closed: ClosedLoops, v: np.ndarray) -> np.ndarray:
        """Return the tool's acceleration (N, 6) at velocities `v` (N, na) without actuated acceleration."""
        rates = np.einsum("van,na->vn", closed.G, v)
        a = self.loops.accelerations(closed, rates, np.zeros((self.robot.na, len(v))))
        moving = compute_motion(self.joints, closed.at, rates, a, np.zeros(3))
        place = self.place_of(closed.at)
        linear = compute_point_acceleration(closed.at, moving, self._joint, place)
        parts = (linear, moving.spinning_up[self._joint])
        return np.concatenate([np.zeros_like(place) if x is None else x for x in parts]).T


_NEWTON_BLOCK = 512  # samples at a time; arrays stay in the processor's cache
_RULES = NewtonRules(60, 6, 0.4, 1e-10, 1e-6)  # steps of a joint [m or rad], damped far from the solution
_ROUGH = 1e-2  # [m] gap that may stay open on a way
_STEPS = 12  # on the way from home
_DAMPING = 1e-4  # largest cost of a joint's motion relative to a rotation of the tool
_LEAST = 1e-10  # of the same, so that idle motions stay defined
_SOFT = 1e-6  # its square times the pull of the orientation is the error of the closure
_IDLE = 1e-7  # singular values relative to the largest; less moves no joint
_NEARBY = 0.05  # [m or rad] from home, where idle motions are searched


class TreeNewton:
    """Solves one robot."""

    def __init__(self, engine: TreePose) -> None:
        """Find at home the motions that do not move the tool."""
        self.engine, self.robot = engine, engine.robot
        model = self.robot.model
        self._active, self._scale = self.robot.active_v, self.robot.drive_scale
        self._share = self.robot.coupling[0] / self._scale  # of the tree's own travel
        self._rests = np.zeros(0, int) if self.robot.loops else self.robot.passive_v
        self._followers = [model.joints[model.getJointId(j)].idx_v for j in self.robot.mimics]
        self.home = self.close_loops(self.robot.home[None])
        # home may be singular (a straight wrist) without idle motion elsewhere: the smallest null space near it counts
        near = np.random.default_rng(0).uniform(-_NEARBY, _NEARBY, (6, self.robot.na))
        x = self.close_loops(np.vstack([self.robot.home, self.robot.home + near]))
        at = compute_frames(engine.joints, x[:, np.isfinite(x).all(axis=0)])
        whole = np.concatenate([self._closure(at), self._fold(engine.twist(at))[:, 3:]], axis=1)
        _, s, vt = np.linalg.svd(whole)
        ranks = np.sum(s > _IDLE * s.max(axis=1, initial=0.0, keepdims=True), axis=1)
        null = vt[np.argmax(ranks), ranks.max() :]
        self.idle = len(null) if np.abs(null[:, self._active]).max(initial=0.0) > _IDLE else 0

    def close_loops(self, q: np.ndarray) -> np.ndarray:
        """Return all joints' positions (nv, N) at actuated ones (N, na); nan where the loops cannot be closed."""
        return np.ascontiguousarray(self.engine.full_positions(q).T)

    def solve(
        self, poses: Poses, x: np.ndarray, toward: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (N, na), codes (N,), errors of position [m] and orientation [rad] (N, 2), the tool's rotations.

        Args:
            poses: Poses of the tool.
            x: All joints' positions to start from (nv, N).
            toward: Actuated positions (N, na) that joints with idle motion approach.
        """
        sound = np.isfinite(poses.position).all(axis=1) & np.isfinite(poses.rotation).all(axis=(1, 2))
        n = len(toward)
        q, error, rotation = np.full(toward.shape, np.nan), np.full((n, 2), np.nan), np.full((n, 3, 3), np.nan)
        for first in range(0, n, _NEWTON_BLOCK):
            part = np.arange(first, min(first + _NEWTON_BLOCK, n))
            found, error[part] = self._found(poses.take(part), x[:, part], toward[part])
            q[part] = found[self._active].T / self._scale
            rotation[part] = self.engine.pose_at(found).rotation
        code = np.where(np.isfinite(q).all(axis=1), OK, OUT_OF_REACH).astype(np.int8)
        code[~sound] = NOT_A_NUMBER
        return q, code, error, rotation

    def _found(self, poses: Poses, x: np.ndarray, toward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the result of `newton`; if idle motion prevents its convergence, solve for the tool first."""
        found, error = self.newton(poses, x, toward)
        lost = np.flatnonzero(~np.isfinite(found[0])) if self.idle else np.zeros(0, int)
        if lost.size:
            part = poses.take(lost)
            there, off = self.newton(part, x[:, lost], None)
            nearer, missed = self.newton(part, there, toward[lost])
            idled = np.isfinite(nearer[0])
            found[:, lost], error[lost] = np.where(idled, nearer, there), np.where(idled[:, None], missed, off)
        return found, error

    def way(self, poses: Poses) -> np.ndarray:
        """Return the positions at the end of the straight way from home (nv, N); nan where it is blocked."""
        n, way = len(poses.position), StraightWay(self.engine.pose_at(self.home), poses)
        x, toward = np.repeat(self.home, n, axis=1), np.repeat(self.robot.home[None], n, axis=0)
        for share in np.linspace(0, 1, _STEPS + 1)[1:-1]:
            here = way.at(share)
            for first in range(0, n, _NEWTON_BLOCK):
                part = slice(first, first + _NEWTON_BLOCK)
                x[:, part] = self.newton(here.take(part), x[:, part], toward[part], _RULES.roughly(4, _ROUGH))[0]
        return x

    def newton(
        self, poses: Poses, x: np.ndarray, toward: np.ndarray | None, rules: NewtonRules = _RULES
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return closed positions (nv, N), nan without a solution, and the tool's errors (N, 2).

        Without `toward` there is no idle motion.
        """
        x, error = x.copy(), np.full((x.shape[1], 2), np.nan)

        def advance(left: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
            dx, gap, error[left] = self._step(poses.take(left), x[:, left], None if toward is None else toward[left])

            def move(share: np.ndarray) -> None:
                x[:, left] += (dx * share[:, None]).T

            return gap, np.abs(dx).max(axis=1), move

        sound = np.isfinite(poses.position).all(axis=1) & np.isfinite(poses.rotation).all(axis=(1, 2))
        closed = iterate_newton(sound & np.isfinite(x).all(axis=0), advance, rules)
        x[:, ~closed], error[~closed] = np.nan, np.nan
        return x, error

    def _step(
        self, poses: Poses, x: np.ndarray, toward: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the step (N, nv), the largest gap (N,) [m] and the tool's errors (N, 2)."""
        at = compute_frames(self.engine.joints, x)
        here, C, T = self.engine.pose_of(at), self._closure(at), self._fold(self.engine.twist(at))[:, 3:]
        away = here.position - poses.position
        gap = np.concatenate([self.engine.loops.gap(at).T, away], axis=1) if self.robot.loops else away
        turn = measure_turns(poses.rotation, here.rotation)
        pull = np.zeros((x.shape[1], x.shape[0]))
        if self.idle and toward is not None:
            vt = np.linalg.svd(np.concatenate([C, T], axis=1))[2][:, -self.idle :]
            pull[:, self._active] = toward * self._scale - x[self._active].T
            pull = np.einsum("nki,nkj,nj->ni", vt, vt, pull)
        left = np.sum(turn**2, axis=1, keepdims=True)
        dx = solve_least_motion_step(C, gap, T, turn, np.clip(left, _LEAST, _DAMPING), pull, _SOFT)
        dx[:, self._rests] = 0.0
        if self._followers:
            dx[:, self._followers] = dx[:, self._active] @ self._share[self._followers].T
        error = np.stack([np.linalg.norm(away, axis=1), np.linalg.norm(turn, axis=1)], axis=1)
        return dx, np.abs(gap).max(axis=1), error

    def _closure(self, at: Frames) -> np.ndarray:
        """Return the derivatives of loops and tool position by all joints (N, 3 * loops + 3, nv)."""
        twist = self._fold(self.engine.twist(at))
        C = np.zeros((len(twist), 3 * len(self.robot.loops) + 3, twist.shape[2]))
        for (r, c), value in self.engine.loops.entries(at).items():
            C[:, r, c] = value
        C = self._fold(C)
        C[:, -3:] = twist[:, :3]
        return C

    def _fold(self, J: np.ndarray) -> np.ndarray:
        """Return derivatives by all joints (N, m, nv), with followers added to their leaders; zero for joints at rest."""
        if self._followers:
            J[:, :, self._active] += J[:, :, self._followers] @ self._share[self._followers]
            J[:, :, self._followers] = 0.0
        J[:, :, self._rests] = 0.0
        return J
