"""Rigid-body dynamics of any tree, with or without loops, for many samples at once; arrays have samples last.

A body's motion per actuated speed is its partial velocity `(L_a, A_a)`: linear, of its frame's origin, and angular. Kane's
form of virtual work then needs neither forces between bodies nor the tree's joint torques,

    tau_a = sum over bodies of L_a . F + A_a . T,
    F = m a + S h,   T = h x a + I dw + w x I w,   S = [dw]x + [w]x [w]x,

with `a` the origin's acceleration minus gravity, `h` the first moment and `I` about the origin, all in the body's axes. `F` and
`T` are linear in the ten inertial numbers, which gives the regressor and the mass matrix. The forces alone are those of the
open tree, `tau_a = G' tau` (`newton_euler.py`). Reference: Khalil & Dombre 2002, ch. 9 and 10; Kane & Levinson 1985. `tree.py`
has the same through Pinocchio, one sample at a time, and the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.equations import Graph, Tape, as_expression_array, build_inputs, find_tape
from tau_dyn.mechanism.frames import (
    FrameMotion,
    Joint,
    Vector,
    add_vectors,
    compute_cross_product,
    compute_frames,
    compute_motion,
    rotate_into_frame,
    transform_point,
)
from tau_dyn.mechanism.loop_arrays import ClosedLoops, Dense, LoopArrays, get_cells
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.mechanism.mechanism import require_tool_frame
from tau_dyn.mechanism.newton_euler import TreeForces, Weight, compute_tree_forces, list_inertial_numbers, list_weights
from tau_dyn.robot import Robot


class BodyMotion(NamedTuple):
    """A body in its own axes.

    Attributes:
        movers: The actuated joints that move it (n,).
        linear: Its origin's velocity per actuated speed (3, n, N).
        angular: Its angular velocity per actuated speed (3, n, N), or None if it cannot turn.
        acceleration: Its origin's acceleration minus gravity (3, N).
        turning: Its angular velocity (3, N), None for zero.
        spinning_up: Its angular acceleration (3, N), None for zero.
    """

    movers: np.ndarray
    linear: np.ndarray
    angular: Vector
    acceleration: Vector
    turning: Vector
    spinning_up: Vector

    def power(self, force: Vector, moment: Vector) -> np.ndarray:
        """Return the actuated forces (n, N) that a force and a moment (3, N) at the body require."""
        out = None
        for partial, acting in ((self.linear, force), (self.angular, moment)):
            if partial is not None and acting is not None:
                for row, x in zip(partial, acting, strict=True):
                    out = row * x if out is None else np.add(out, row * x, out=out)
        return np.zeros_like(self.linear, shape=self.linear.shape[1:]) if out is None else out


def compute_body_columns(body: BodyMotion, wanted: list[int]) -> list[np.ndarray | None]:
    """Return the actuated forces (n, N) per unit of each of the ten inertial numbers; None for zero, and for those not wanted."""
    out: list[np.ndarray | None] = [None] * 10
    a, A = body.acceleration, body.angular
    if 0 in wanted and a is not None:
        out[0] = body.power(a, None)
    S = _spin_matrix(body)
    if set(wanted) & {1, 2, 3}:
        lever = None if a is None or A is None else compute_cross_product(a[:, None], A)
        for k in range(3):
            part = None if S is None else _product([row[k] for row in S], body.linear)
            out[1 + k] = add_vectors(part, None if lever is None else lever[k])
    if S is not None and A is not None and set(wanted) & set(range(4, 10)):
        out[4:] = _inertia_columns(body, S, A)
    return out


def _product(column: Sequence[np.ndarray], partial: np.ndarray) -> np.ndarray:
    """Return the scalar products (n, N) of a vector's rows and partial velocities (3, n, N)."""
    return column[0] * partial[0] + column[1] * partial[1] + column[2] * partial[2]


def _spin_matrix(body: BodyMotion) -> list[list[np.ndarray]] | None:
    """Return the rows of `S = [dw]x + [w]x [w]x`, or None if the body does not turn."""
    if body.turning is None and body.spinning_up is None:
        return None
    zero = np.zeros_like(body.linear, shape=(3, body.linear.shape[2]))
    x, y, z = zero if body.turning is None else body.turning
    dx, dy, dz = zero if body.spinning_up is None else body.spinning_up
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return [[-(yy + zz), xy - dz, xz + dy], [xy + dz, -(xx + zz), yz - dx], [xz - dy, yz + dx, -(xx + yy)]]


def _inertia_columns(body: BodyMotion, S: list[list[np.ndarray]], A: np.ndarray) -> list[np.ndarray]:
    """Return the actuated forces (n, N) per unit of `Ixx, Ixy, Iyy, Ixz, Iyz, Izz`."""
    zero = np.zeros_like(A, shape=(3, A.shape[2]))
    x, y, z = zero if body.turning is None else body.turning
    dx, dy, dz = zero if body.spinning_up is None else body.spinning_up
    xy, xz, yz = x * y, x * z, y * z
    moments = (
        (dx, xz, -xy),
        (-S[2][0], S[2][1], S[0][0] - S[1][1]),
        (-yz, dy, xy),
        (S[1][0], S[2][2] - S[0][0], -S[1][2]),
        (S[1][1] - S[2][2], -S[0][1], S[0][2]),
        (yz, -xz, dz),
    )
    return [A[0] * one + A[1] * two + A[2] * three for one, two, three in moments]


_BLOCK = 1024
"""Samples computed at once: few enough for all of a body's numbers to stay in the processor's cache."""


class Partial(NamedTuple):
    """How a joint's frame moves per actuated speed: the actuated joints that move it (n,), and (3, n, N) each."""

    movers: np.ndarray
    linear: np.ndarray
    angular: Vector


class WeightArms(NamedTuple):
    """Factors of gravity's direction, body by body.

    Attributes:
        bodies: Joints that carry the bodies (b,).
        places: Mass times place of each body in the base frame (N, b, 3) [kg m].
        rates: Change of the places per actuated speed (N, na, b, 3), [kg m] of a turn, [kg] of a slide; `tau = -rates . g`.
    """

    bodies: tuple[str, ...]
    places: np.ndarray
    rates: np.ndarray


class BatchedTree:
    """Dynamics of one robot for arrays of samples; see `Mechanism` for the return value of each method."""

    def __init__(
        self,
        robot: Robot,
        solver: LoopSolver,
        joints: list[Joint],
        value: Callable[[str], Any] | None = None,
        loops: LoopArrays | None = None,
    ) -> None:
        """Prepare for a robot.

        Args:
            robot: The robot.
            solver: Closes its loops one sample after the other.
            joints: Its tree.
            value: Gives a parameter by its name, a number or an expression; by default the robot's number.
            loops: Closes its loops; by default with numbers.
        """
        self.robot, self.solver, self.joints = robot, solver, joints
        self.loops = LoopArrays(solver, joints, get_cells(robot)) if loops is None else loops
        self.gravity = np.asarray(solver.model.gravity.linear, float)
        first = np.cumsum([0, *(len(link.own) for link in robot.links)])
        self._links = [(link, link.map, int(k)) for link, k in zip(robot.links, first, strict=False)]
        self._armature = int(first[-1])
        self._n_computed = 0  # samples of the regressor
        self._passive = solver.passive_v if robot.loops else np.zeros(0, int)
        value = value or dict(zip(robot.parameters.names, robot.parameters.values, strict=True)).__getitem__
        self.pi = list_inertial_numbers(robot, value)
        self.drive = np.array([value(f"{joint}.armature") for joint in robot.actuated])
        self.weights = list_weights(robot, value)

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p), laid out in memory as (na, p, N)."""
        n = len(q)
        self._n_computed += n
        found = find_tape(self._content, self._n_computed, self._trace_columns)
        Y = np.zeros((self.robot.na, len(self.robot.parameters), _pad(n)))[:, :, :n]
        for part in iterate_blocks(n):
            if found is None:
                self._fill(Y[:, :, part], *self._moving(q[part], v[part], a[part]))
            else:
                found[0].run(self._list_rows(q[part], v[part], a[part]), Y[:, :, part], found[1])
        joints = range(self.robot.na)
        Y[joints, [self._armature + j for j in joints]] = a.T
        return Y.transpose(2, 0, 1)

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na)."""
        tau = (self.drive * a).T.copy()
        for part in iterate_blocks(len(q)):
            closed, tree = self.open_tree(q[part], v[part], a[part])
            tau[:, part] += np.einsum("van,vn->an", closed.G, tree.tau)
        return tau.T

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na)."""
        M = np.zeros_like(q, shape=(self.robot.na, self.robot.na, len(q)), order="C")
        for part in iterate_blocks(len(q)):
            closed = self.loops.close(q[part])
            for k in range(self.robot.na):  # forces of a unit acceleration from rest, without weight
                tree = compute_tree_forces(self.joints, (closed.x, None, closed.G[:, k]), self.pi, (), np.zeros(3))
                M[:, k, part] = np.einsum("van,vn->an", closed.G, tree.tau)
        M[range(self.robot.na), range(self.robot.na)] += self.drive[:, None]
        return M.transpose(2, 0, 1)

    def weight_arms(self, q: np.ndarray) -> WeightArms:
        """Return first moments of all bodies and their motion (N); masses that only gravity acts on are included."""
        places = np.zeros((len(self._links), 3, len(q)))
        rates = np.zeros((self.robot.na, len(self._links), 3, len(q)))
        for part in iterate_blocks(len(q)):
            closed = self.loops.close(q[part])
            partials = self._partials(closed)
            for k, (link, _, _) in enumerate(self._links):
                joint, pi = link.joint_id, self.pi[link.joint_id]
                held = [(w.mass, w.mass * w.local) for w in self.weights if w.joint == joint]
                mass, moment = pi[0] + sum(m for m, _ in held), pi[1:4] + sum(h for _, h in held)
                arm, partial = np.einsum("ijn,j->in", closed.at.rotation[joint], moment), partials[joint]
                places[k, :, part] = mass * closed.at.origin[joint] + arm
                moved, turning = mass * partial.linear, compute_cross_product(partial.angular, arm[:, None])
                moved = moved if turning is None else moved + turning
                rates[partial.movers, k, :, part] = moved.transpose(1, 0, 2)
        names = tuple(str(self.solver.model.names[link.joint_id]) for link, _, _ in self._links)
        return WeightArms(names, places.transpose(2, 0, 1), rates.transpose(3, 0, 1, 2))

    def redundant_motion(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the motion of redundant drives (N, r, na + 2)."""
        rows = find_velocity_indices(self.solver.model, self.robot.redundant_joints)
        out = np.zeros((len(rows), self.robot.na + 2, len(q)))
        for part in iterate_blocks(len(q)):
            closed, speeds, changes = self._moving(q[part], v[part], a[part])
            out[:, :, part] = np.concatenate([closed.G[rows], speeds[rows, None], changes[rows, None]], axis=1)
        return out.transpose(2, 0, 1)

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m]."""
        return self._tool(q)[0]

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per actuated speed (N, 3, na), in base axes."""
        return self._tool(q)[1]

    def _tool(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        frame = self.solver.model.frames[require_tool_frame(self.robot)]
        place, J = (np.zeros_like(q, shape=(*shape, len(q)), order="C") for shape in ((3,), (3, self.robot.na)))
        for part in iterate_blocks(len(q)):
            closed = self.loops.close(q[part])
            partial = self._partials(closed)[frame.parentJoint]
            place[:, part] = transform_point(closed.at, frame.parentJoint, frame.placement.translation)
            J[:, partial.movers, part] = self._velocity(closed, partial, frame.parentJoint, place[:, part])
        return place.T, J.transpose(2, 0, 1)

    def open_tree(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[ClosedLoops, TreeForces]:
        """Return closed configurations, and the forces of the tree with its loops cut, for at most one block of samples."""
        closed, speeds, changes = self._moving(q, v, a)
        state = closed.x, speeds, changes
        return closed, compute_tree_forces(self.joints, state, self.pi, self.weights, self.gravity)

    def _moving(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[ClosedLoops, np.ndarray, np.ndarray]:
        """Return closed configurations with the velocities and accelerations of all joints (nv, N)."""
        closed = self.loops.close(q)
        speeds = np.einsum("van,na->vn", closed.G, v)
        return closed, speeds, self.loops.accelerations(closed, speeds, a.T)

    @cached_property
    def _content(self) -> tuple[bytes, ...]:
        """Everything on which the columns' formulas depend."""
        numbers = [x for joint in self.joints for x in joint] + [self.robot.coupling[0], self._passive, self.gravity]
        numbers += [len(self.joints), self.robot.na, len(self.robot.parameters)]
        numbers += [x for link, map_, first in self._links for x in (link.joint_id, map_, first)]
        numbers += [x for weight in self.weights for x in (weight.column, weight.joint, weight.local)]
        return tuple(np.asarray(x, float).tobytes() for x in numbers)

    def _list_rows(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return positions, velocities and accelerations of all joints, and `G` of the passive ones, as rows (m, N)."""
        if not self.robot.loops:
            share, offset = self.robot.coupling
            return np.concatenate([share @ q.T + offset[:, None], share @ v.T, share @ a.T])
        closed, speeds, changes = self._moving(q, v, a)
        return np.concatenate([closed.x, speeds, changes, closed.G[self._passive].reshape(-1, len(q))])

    def _trace_columns(self) -> Tape:
        """Return `_fill` on expressions, as a function of `_list_rows`."""
        graph, rng, (nv, na) = Graph(), np.random.default_rng(0), self.robot.coupling[0].shape
        x, speeds, changes = (build_inputs(graph, name, rng.standard_normal(nv)) for name in "xva")
        passive = build_inputs(graph, "G", rng.standard_normal(len(self._passive) * na))
        G = as_expression_array(self.robot.coupling[0])
        G[self._passive] = passive.reshape(-1, na)
        Y = as_expression_array(np.zeros((na, len(self.robot.parameters), 1)))
        at = compute_frames(self.joints, x[:, None])
        closed = ClosedLoops(x[:, None], at, Dense(np.zeros((1, 0, 0))), G[:, :, None])
        self._fill(Y, closed, speeds[:, None], changes[:, None])
        return Tape(graph, [*x, *speeds, *changes, *passive], list(np.ravel(Y)))

    def _fill(self, Y: np.ndarray, closed: ClosedLoops, speeds: np.ndarray, changes: np.ndarray) -> None:
        """Add the columns at closed configurations with all joints' velocities and accelerations (nv, N), except armatures'."""
        moving = compute_motion(self.joints, closed.at, speeds, changes, -self.gravity)
        partials = self._partials(closed)
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

    def _body(self, closed: ClosedLoops, moving: FrameMotion, partial: Partial, joint: int) -> BodyMotion:
        """Return a body's partial velocities and motion in its own axes."""
        rotation = closed.at.rotation[joint]

        def own(x: Vector) -> Vector:
            return None if x is None else rotate_into_frame(rotation[:, :, None] if x.ndim == 3 else rotation, x)

        a, w, dw = (own(x[joint]) for x in (moving.acceleration, moving.turning, moving.spinning_up))
        linear = rotate_into_frame(rotation[:, :, None], partial.linear)
        return BodyMotion(partial.movers, linear, own(partial.angular), a, w, dw)

    def _partials(self, closed: ClosedLoops) -> list[Partial]:
        """Return the partial velocities of all joints' frames, in world axes."""
        n = closed.x.shape[1]
        found = [Partial(np.zeros(0, int), np.zeros_like(closed.x, shape=(3, 0, n)), None)]
        share, passive = self.robot.coupling[0], set(self._passive.tolist())
        for joint in self.joints:
            parent = found[joint.parent]
            arm = closed.at.origin[joint.index] - closed.at.origin[joint.parent]
            carried = add_vectors(parent.linear, compute_cross_product(parent.angular, arm[:, None]))
            z = closed.at.axis[joint.index][:, None]
            own = np.arange(self.robot.na) if joint.v in passive else np.flatnonzero(share[joint.v])
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
        return _product(list(-self.gravity), self._velocity(closed, partial, weight.joint, place))


def find_velocity_indices(model: pin.Model, joints: Sequence[str]) -> list[int]:
    """Return the indices of joints of one freedom in the tree's velocity."""
    return [model.joints[model.getJointId(name)].idx_v for name in joints]


def _as_slice(movers: np.ndarray) -> slice | np.ndarray:
    """Return consecutive joints as a slice, which avoids a copy."""
    n = len(movers)
    return slice(movers[0], movers[0] + n) if n and movers[-1] - movers[0] == n - 1 else movers


def _sum(terms: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Return the sum of arrays with factors."""
    (factor, out), *rest = terms
    out = out if factor == 1.0 else factor * out
    for factor, x in rest:
        out = out + factor * x
    return out


def _pad(n: int) -> int:
    """Return a length of rows from which the same sample of many rows has different places in the processor's cache."""
    return 16 * -(-n // 16) + 8


def iterate_blocks(n: int) -> Iterator[slice]:
    """Yield slices of at most one block that together make n samples."""
    for start in range(0, n, _BLOCK):
        yield slice(start, min(start + _BLOCK, n))


def _spread(x: np.ndarray, of: np.ndarray, movers: np.ndarray) -> np.ndarray:
    """Return a copy (3, n, N) of columns of some actuated joints among those of more."""
    if len(of) == len(movers):
        return x.copy()
    out = np.zeros_like(x, shape=(3, len(movers), x.shape[2]), order="C")
    out[:, np.searchsorted(movers, of)] = x
    return out
