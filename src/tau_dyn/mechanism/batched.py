r"""Rigid-body dynamics of any tree, with or without loops, for many samples at once.

A body's motion per actuated speed is its partial velocity `(L_a, A_a)`: linear, of its frame's origin, and angular. Kane's
form of virtual work then needs neither forces between bodies nor the tree's joint torques,

    tau_a = sum over bodies of L_a . F + A_a . T,
    F = m a + S h,   T = h x a + I dw + w x I w,   S = [dw]x + [w]x [w]x,

with `a` the origin's acceleration minus gravity, `h` the first moment and `I` about the origin, all in the body's axes. `F` and
`T` are linear in the ten inertial numbers, which gives the regressor. Reference: Khalil & Dombre 2002, ch. 9 and 10; Kane &
Levinson 1985. `samplewise.py` has the same through Pinocchio, one sample at a time, and the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.body_columns import BodyMotion, compute_body_columns, compute_body_wrench, compute_momentum
from tau_dyn.mechanism.loop_arrays import ClosedLoops, LoopArrays
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.mechanism.tree_arrays import (
    FrameMotion,
    Joint,
    Vector,
    add_vectors,
    compute_cross_product,
    compute_motion,
    list_joints,
    rotate_into_frame,
    transform_point,
)
from tau_dyn.robot import Robot

_BLOCK = 1024
"""Samples computed at once: few enough for all of a body's numbers to stay in the processor's cache."""


class Partial(NamedTuple):
    """How a joint's frame moves per actuated speed: the actuated joints that move it (n,), and (3, n, N) each."""

    movers: np.ndarray
    linear: np.ndarray
    angular: Vector


class Weight(NamedTuple):
    """A mass that only gravity feels: its column among the parameters, joint, place in that joint's frame, and value [kg]."""

    column: int
    joint: int
    local: np.ndarray
    mass: float


class BatchedTree:
    """Dynamics of one robot for arrays of samples; see `Mechanism` for what each method returns."""

    def __init__(self, robot: Robot, solver: LoopSolver, joints: list[Joint]) -> None:
        """Prepare for a robot with its parameters' values; `BatchedTree.of` says whether that is possible."""
        self.robot, self.solver, self.joints = robot, solver, joints
        self.loops = LoopArrays(solver, joints)
        self.gravity = np.asarray(solver.model.gravity.linear, float)
        names = robot.parameters.names
        first = np.cumsum([0, *(len(link.own) for link in robot.links)])
        self._links = [(link, link.map, int(k)) for link, k in zip(robot.links, first, strict=False)]
        self._armature = int(first[-1])
        self.pi = {link.joint_id: link.map @ robot.parameters.select(link.names).values for link in robot.links}
        self.drive = robot.parameters.values[self._armature : self._armature + robot.na]
        self.weights = [
            _weight(robot, solver, name, names.index(name)) for name in names if name.endswith(".gravity_mass")
        ]

    @classmethod
    def of(cls, robot: Robot, solver: LoopSolver) -> BatchedTree | None:
        """Return the batched dynamics of a robot, or None where a joint has more than one degree of freedom."""
        joints = list_joints(solver.model)
        return None if joints is None else cls(robot, solver, joints)

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p), laid out in memory as (na, p, N)."""
        Y = np.zeros((self.robot.na, len(self.robot.parameters), len(q)))
        for part in iterate_blocks(len(q)):
            self._fill(Y[:, :, part], q[part], v[part], a[part])
        joints = range(self.robot.na)
        Y[joints, [self._armature + j for j in joints]] = a.T
        return Y.transpose(2, 0, 1)

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na)."""
        tau = (self.drive * a).T.copy()
        for part in iterate_blocks(len(q)):
            closed, moving, partials = self._moving(q[part], v[part], a[part])
            for link, _, _ in self._links:
                body = self._body(closed, moving, partials[link.joint_id], link.joint_id)
                tau[body.movers, part] += body.power(*compute_body_wrench(body, self.pi[link.joint_id]))
            for weight in self.weights:
                partial = partials[weight.joint]
                tau[partial.movers, part] += weight.mass * self._held(closed, partial, weight)
        return tau.T

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na)."""
        M = np.zeros((self.robot.na, self.robot.na, len(q)))
        for part in iterate_blocks(len(q)):
            closed = self.loops.close(q[part])
            partials = self._partials(closed)
            for link, _, _ in self._links:
                partial = partials[link.joint_id]
                body = self._body(closed, None, partial, link.joint_id)
                for k, other in enumerate(partial.movers):
                    one = body.linear[:, k], None if body.angular is None else body.angular[:, k]
                    M[partial.movers, other, part] += body.power(*compute_momentum(*one, self.pi[link.joint_id]))
        M[range(self.robot.na), range(self.robot.na)] += self.drive[:, None]
        return M.transpose(2, 0, 1)

    def tool(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's position (N, 3) [m] and velocity per actuated speed (N, 3, na), in base axes."""
        frame = self.solver.model.frames[self.robot.tool_frame]
        place, J = np.empty((3, len(q))), np.zeros((3, self.robot.na, len(q)))
        for part in iterate_blocks(len(q)):
            closed = self.loops.close(q[part])
            partial = self._partials(closed)[frame.parentJoint]
            place[:, part] = transform_point(closed.at, frame.parentJoint, frame.placement.translation)
            J[:, partial.movers, part] = self._velocity(closed, partial, frame.parentJoint, place[:, part])
        return place.T, J.transpose(2, 0, 1)

    def moving(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[ClosedLoops, FrameMotion]:
        """Return closed configurations and their motion, accelerations minus gravity, for at most one block of samples."""
        closed = self.loops.close(q)
        speeds = np.einsum("van,na->vn", closed.G, v)
        accelerations = self.loops.accelerations(closed, speeds, a.T)
        return closed, compute_motion(self.joints, closed.at, speeds, accelerations, -self.gravity)

    def _moving(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[ClosedLoops, FrameMotion, list[Partial]]:
        closed, moving = self.moving(q, v, a)
        return closed, moving, self._partials(closed)

    def _fill(self, Y: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        closed, moving, partials = self._moving(q, v, a)
        for link, map_, first in self._links:
            body = self._body(closed, moving, partials[link.joint_id], link.joint_id)
            basis = compute_body_columns(body, np.flatnonzero(map_.any(axis=1)).tolist())
            movers = _as_slice(body.movers)
            for k, pi in enumerate(map_.T):
                terms = [(pi[n], x) for n, x in enumerate(basis) if x is not None and pi[n]]
                if terms:
                    Y[movers, first + k] = _sum(terms)
        for weight in self.weights:
            partial = partials[weight.joint]
            Y[partial.movers, weight.column] += self._held(closed, partial, weight)

    def _body(self, closed: ClosedLoops, moving: FrameMotion | None, partial: Partial, joint: int) -> BodyMotion:
        """Return a body's partial velocities and motion in its own axes; without motion where none is given."""
        rotation = closed.at.rotation[joint]

        def own(x: Vector) -> Vector:
            return None if x is None else rotate_into_frame(rotation[:, :, None] if x.ndim == 3 else rotation, x)

        turning = (None, None, None)
        if moving is not None:
            turning = moving.acceleration[joint], moving.turning[joint], moving.spinning_up[joint]
        a, w, dw = (own(x) for x in turning)
        linear = rotate_into_frame(rotation[:, :, None], partial.linear)
        return BodyMotion(partial.movers, linear, own(partial.angular), a, w, dw)

    def _partials(self, closed: ClosedLoops) -> list[Partial]:
        """Return the partial velocities of all joints' frames, in world axes."""
        n = closed.x.shape[1]
        found = [Partial(np.zeros(0, int), np.zeros((3, 0, n)), None)]
        driven = {int(v): k for k, v in enumerate(self.solver.active_v)}
        for joint in self.joints:
            parent = found[joint.parent]
            arm = closed.at.origin[joint.index] - closed.at.origin[joint.parent]
            carried = add_vectors(parent.linear, compute_cross_product(parent.angular, arm[:, None]))
            z = closed.at.axis[joint.index][:, None]
            if joint.v in driven:
                own, rate = np.array([driven[joint.v]]), z
            else:
                own = np.arange(self.robot.na) if self.robot.loops else np.zeros(0, int)
                rate = z * closed.G[joint.v, own]
            movers = np.union1d(parent.movers, own).astype(int)
            linear = _spread(carried, parent.movers, movers)
            angular = None if parent.angular is None else _spread(parent.angular, parent.movers, movers)
            if own.size:
                place = np.searchsorted(movers, own)
                if joint.slides:
                    linear[:, place] += rate
                else:
                    angular = np.zeros_like(linear) if angular is None else angular
                    angular[:, place] += rate
            found.append(Partial(movers, linear, angular))
        return found

    def _velocity(self, closed: ClosedLoops, partial: Partial, joint: int, place: np.ndarray) -> np.ndarray:
        """Return how a point (3, N) that a joint carries moves per actuated speed (3, n, N)."""
        arm = place - closed.at.origin[joint]
        return add_vectors(partial.linear, compute_cross_product(partial.angular, arm[:, None]))

    def _held(self, closed: ClosedLoops, partial: Partial, weight: Weight) -> np.ndarray:
        """Return the actuated forces (n, N) that hold 1 kg against gravity."""
        place = transform_point(closed.at, weight.joint, weight.local)
        return -np.einsum("xan,x->an", self._velocity(closed, partial, weight.joint, place), self.gravity)


def _as_slice(movers: np.ndarray) -> slice | np.ndarray:
    """Return joints that follow each other as a slice, which copies nothing."""
    n = len(movers)
    return slice(movers[0], movers[0] + n) if n and movers[-1] - movers[0] == n - 1 else movers


def _sum(terms: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Return the sum of arrays with factors."""
    (factor, out), *rest = terms
    out = out if factor == 1.0 else factor * out
    for factor, x in rest:
        out = out + factor * x
    return out


def iterate_blocks(n: int) -> Iterator[slice]:
    """Yield slices of at most one block that together make n samples."""
    for start in range(0, n, _BLOCK):
        yield slice(start, min(start + _BLOCK, n))


def _spread(x: np.ndarray, of: np.ndarray, movers: np.ndarray) -> np.ndarray:
    """Return a copy (3, n, N) of columns of some actuated joints among those of more."""
    if len(of) == len(movers):
        return x.copy()
    out = np.zeros((3, len(movers), x.shape[2]))
    out[:, np.searchsorted(movers, of)] = x
    return out


def _weight(robot: Robot, solver: LoopSolver, name: str, column: int) -> Weight:
    frame = solver.model.frames[solver.model.getFrameId(name.rsplit(".", 1)[0])]
    return Weight(column, int(frame.parentJoint), frame.placement.translation.copy(), robot.parameters[name].value)
