"""Dynamics of any tree, all samples at once or one by one, and the choice of dynamics for a robot."""

from __future__ import annotations

from functools import wraps
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.mechanism.batched import BatchedTree, Partial, compute_body_wrench, iterate_blocks
from tau_dyn.mechanism.frames import (
    FrameMotion,
    Joint,
    Vector,
    add_vectors,
    compute_cross_product,
    list_joints,
    rotate_into_frame,
    transform_point,
)
from tau_dyn.mechanism.gantry_tau import GantryTauMechanism
from tau_dyn.mechanism.loop_arrays import ClosedLoops
from tau_dyn.mechanism.loops import LoopSolver, find_passive_pairs
from tau_dyn.mechanism.mechanism import Mechanism
from tau_dyn.mechanism.samplewise import SamplewiseTree
from tau_dyn.mechanism.small_systems import measure_column_lengths
from tau_dyn.robot import Robot


class _Load(NamedTuple):
    """What acts on one joint's body: force and moment (3, N) about its origin, in world axes, None for zero."""

    force: Vector
    moment: Vector


class LoadedTree(BatchedTree):
    """Batched dynamics, and what joints carry inside a mechanism: forces across guideways, and how bearings turn.

    No drive holds the passive joints, so the loops' forces `lambda` do: `J_p' lambda = tau_p`, where `tau_p` are the forces that
    the open tree would need there. What everything beyond a slide's own link puts on that link is then the loops' pulls on its
    subtree less what accelerates and carries the bodies behind it. Moments do not pass into it. All in world axes.
    """

    def __init__(self, robot: Robot, solver: LoopSolver, joints: list[Joint]) -> None:
        """Prepare for a robot with its parameters' values."""
        super().__init__(robot, solver, joints)
        self._pairs = find_passive_pairs(robot, solver.model)

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
        out = np.zeros((self.robot.na, 3, len(q)))
        for part in iterate_blocks(len(q)):
            self._fill_guides(out[:, :, part], q[part], v[part], a[part])
        return out.transpose(2, 0, 1)

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn per actuated speed (N, n, 3, na); see `loops.py`."""
        pairs = self._pairs
        out = np.zeros((len(pairs), 3, self.robot.na, len(q)))
        for part in iterate_blocks(len(q) if pairs else 0):
            closed = self.loops.close(q[part])
            turns = {j.v: closed.at.axis[j.index][:, None] * closed.G[j.v] for j in self.joints if not j.slides}
            for k, pair in enumerate(pairs):
                if pair.hinge is not None:
                    out[k, 0, :, part] = closed.G[pair.hinge]
                    continue
                for index in np.flatnonzero(pair.weights).tolist():
                    if index in turns:
                        out[k, :, :, part] += pair.weights[index] * turns[index]
        return tuple(pair.name for pair in pairs), out.transpose(3, 0, 1, 2)

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,); see `Mechanism.condition`."""
        if not self.robot.loops:
            return np.ones(len(q))
        found = []
        for part in iterate_blocks(len(q)):
            J = self.loops.jacobian(self.loops.close(q[part]).at)
            s = np.linalg.svd(J / measure_column_lengths(J)[:, None, :], compute_uv=False)
            singular = s[:, -1] <= 1e-10 * s[:, 0]
            found.append(np.divide(s[:, 0], s[:, -1], out=np.full(len(s), np.inf), where=~singular))
        return np.concatenate(found)

    def _fill_guides(self, out: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        closed, moving = self.moving(q, v, a)
        inertial = {link.joint_id: self._inertial(closed, moving, link.joint_id) for link in self.robot.links}
        pulls = self._pulls(closed, inertial)
        model = self.solver.model
        for i, (name, kind) in enumerate(zip(self.robot.actuated, self.robot.joint_kinds, strict=True)):
            if kind != "prismatic":
                continue
            own = model.getJointId(name)
            inside = [j.index for j in self.joints if own in model.supports[j.index].tolist()]
            beyond = np.zeros((3, len(q)))
            for j in inside:
                beyond += pulls.get(j, 0.0)
                if j != own:
                    needed = inertial[j].force if j in inertial else None
                    beyond -= 0.0 if needed is None else needed
                    beyond += sum(w.mass for w in self.weights if w.joint == j) * self.gravity[:, None]
            axis = closed.at.axis[own]
            out[i] = beyond - (beyond * axis).sum(axis=0) * axis

    def _inertial(self, closed: ClosedLoops, moving: FrameMotion, joint: int) -> _Load:
        """Return what accelerates and carries a body."""
        blank = Partial(np.zeros(0, int), np.zeros((3, 0, closed.x.shape[1])), None)
        force, moment = compute_body_wrench(self._body(closed, moving, blank, joint), self.pi[joint])
        back = closed.at.rotation[joint].transpose(1, 0, 2)
        return _Load(*(None if x is None else rotate_into_frame(back, x) for x in (force, moment)))

    def _pulls(self, closed: ClosedLoops, inertial: dict[int, _Load]) -> dict[int, np.ndarray]:
        """Return the loops' forces (3, N) on the joints' bodies they end on."""
        found: dict[int, np.ndarray] = {}
        if not self.robot.loops:
            return found
        tau = self._open_tree(closed, inertial)[self.solver.passive_v]
        forces = closed.inverse.solve_transposed(tau).reshape(len(self.robot.loops), 3, -1)
        for loop, force in zip(self.robot.loops, forces, strict=True):
            for frame, sign in ((loop.frame_a, 1.0), (loop.frame_b, -1.0)):
                joint = self.solver.model.frames[frame].parentJoint
                found[joint] = found.get(joint, 0.0) + sign * force
        return found

    def _open_tree(self, closed: ClosedLoops, inertial: dict[int, _Load]) -> np.ndarray:
        """Return the tree's joint forces (nv, N) with all loops cut: the recursion from the tips to the base."""
        at, n = closed.at, closed.x.shape[1]
        force: list[Vector] = [None] * (len(self.joints) + 1)
        moment: list[Vector] = [None] * (len(self.joints) + 1)
        for joint, load in inertial.items():
            force[joint], moment[joint] = load
        for weight in self.weights:
            held = np.repeat(-weight.mass * self.gravity[:, None], n, axis=1)
            arm = transform_point(at, weight.joint, weight.local) - at.origin[weight.joint]
            force[weight.joint] = add_vectors(force[weight.joint], held)
            moment[weight.joint] = add_vectors(moment[weight.joint], compute_cross_product(arm, held))
        tau = np.zeros((self.solver.model.nv, n))
        for joint in reversed(self.joints):
            f, m = force[joint.index], moment[joint.index]
            acting = f if joint.slides else m
            if acting is not None:
                tau[joint.v] = (at.axis[joint.index] * acting).sum(axis=0)
            arm = at.origin[joint.index] - at.origin[joint.parent]
            force[joint.parent] = add_vectors(force[joint.parent], f)
            moment[joint.parent] = add_vectors(moment[joint.parent], add_vectors(m, compute_cross_product(arm, f)))
        return tau


MAX_ONE_BY_ONE = 12
"""Samples up to which one by one is quicker."""


def _by_number(name: str) -> Any:
    """Return a method that takes few samples one by one through Pinocchio, and many all at once."""
    one = getattr(SamplewiseTree, name)

    @wraps(one)
    def method(self: TreeMechanism, q: np.ndarray, *rest: np.ndarray) -> Any:
        if self.batched is None or np.ndim(q) != 2 or len(q) <= MAX_ONE_BY_ONE:
            return one(self, q, *rest)
        return getattr(self.batched, name)(*self._checked(q, *rest))

    return method


_inverse_dynamics, _inertia = _by_number("inverse_dynamics"), _by_number("inertia")


class TreeMechanism(SamplewiseTree):
    """Dynamics of a tree with loops.

    A controller and a simulator ask for one sample at a time, which Pinocchio answers 50 times as fast as arrays do; of two
    thousand samples arrays are three to six times as fast. Trees with joints of more than one degree of freedom know one by one
    alone. Both give the same numbers.
    """

    regressor = _by_number("regressor")
    guide_force = _by_number("guide_force")
    passive_rates = _by_number("passive_rates")
    tool_position = _by_number("tool_position")
    tool_jacobian = _by_number("tool_jacobian")
    condition = _by_number("condition")

    def __init__(self, robot: Robot) -> None:
        """Prepare for the robot's parameter values."""
        super().__init__(robot)
        joints = list_joints(self.model)
        self.batched = None if joints is None else LoadedTree(robot, self.solver, joints)
        free = not (robot.loops or self._gravity_only or self._unplaced)
        self._plain = free and self.model.nq == self.model.nv and hasattr(pin, "rneaInParallel")

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); Pinocchio takes many samples of a tree without loops in one call."""
        if not self._plain or np.ndim(q) != 2 or len(q) <= MAX_ONE_BY_ONE:
            return _inverse_dynamics(self, q, v, a)
        share, offset = self.robot.coupling
        x, *rates = (np.asfortranarray(share @ one.T) for one in self._checked(q, v, a))
        tree = pin.rneaInParallel(1, pin.ModelPool(self.model, 1), x + offset[:, None], *rates)
        return np.ascontiguousarray((share.T @ tree.reshape(x.shape)).T)

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na); of a tree without loops by Pinocchio's composite bodies, sample by sample."""
        if not self._plain or np.ndim(q) != 2:
            return _inertia(self, q)
        share, offset = self.robot.coupling
        rows = self._checked(q)[0] @ share.T + offset
        tree = np.empty((len(rows), self.model.nv, self.model.nv))
        for k, row in enumerate(rows):
            tree[k] = pin.crba(self.model, self.data, row)
        half = share.T @ (self._upper * tree) @ share
        return half + half.swapaxes(1, 2)


def build_mechanism(robot: Robot) -> Mechanism:
    """Return the fastest exact dynamics for a robot: the closed form where its file declares one that holds, else Pinocchio.

    It holds where rods are slender, sit on the carts' origins and follow their masses; one sample near home shows it. Dynamics
    remember the last closure, so every call makes its own; its kinematics are kept beside the robot (`build_kinematics`).

    Example:
        >>> mechanism = td.build_mechanism(td.load_robot("linear_axis"))
        >>> mechanism.inverse_dynamics(np.array([[0.0]]), np.array([[0.0]]), np.array([[1.0]]))
        array([[95.]])
    """
    mechanism: Mechanism = TreeMechanism(robot)
    if GantryTauMechanism.describes(robot):
        closed = GantryTauMechanism(robot)
        sample = robot.home[None] + 0.01, np.array([[0.3, -0.2, 0.1]]), np.array([[1.0, -1.0, 0.5]])
        Y = mechanism.regressor(*sample)
        same_forces = np.abs(closed.regressor(*sample) - Y).max() < 1e-7 * np.abs(Y).max()
        same_tool = np.abs(closed.tool_position(sample[0]) - mechanism.tool_position(sample[0])).max() < 1e-9
        mechanism = closed if same_forces and same_tool else mechanism
    return mechanism
