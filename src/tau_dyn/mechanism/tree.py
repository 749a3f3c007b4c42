"""Dynamics of any tree, all samples at once or one by one, and the choice of dynamics for a robot.

What joints carry inside a mechanism, for many samples at once: forces across guideways, and how bearings turn.

No drive holds the passive joints, so the loops' forces `lambda` do: `J_p' lambda = tau_p`, where `tau_p` are the forces that
the open tree would need there. What everything beyond a slide's own link puts on that link is then the loops' pulls on its
subtree less what accelerates and carries the bodies behind it. Moments do not pass into it. All in world axes.

Any tree, with or without loops: all samples at once, or one by one through Pinocchio where there are few.

A controller and a simulator ask for one sample at a time, for which Pinocchio is quicker; so are its mass matrix and bias. Trees
with joints of more than one degree of freedom (a passive ball) also take that way. Both give the same numbers.

Which implementation of `Mechanism` suits a robot: the closed form where it holds, else the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.batched import BatchedTree, BodyMotion, compute_body_wrench, iterate_blocks
from tau_dyn.mechanism.frames import (
    FrameMotion,
    Vector,
    add_vectors,
    compute_cross_product,
    rotate_into_frame,
    transform_point,
)
from tau_dyn.mechanism.gantry_tau import GantryTauMechanism
from tau_dyn.mechanism.loop_arrays import ClosedLoops
from tau_dyn.mechanism.loops import BearingPair
from tau_dyn.mechanism.mechanism import Mechanism
from tau_dyn.mechanism.samplewise import SamplewiseTree
from tau_dyn.mechanism.small_systems import measure_column_lengths
from tau_dyn.robot import Robot


class _Load(NamedTuple):
    """What acts on one joint's body: force and moment (3, N) about its origin, in world axes, None for zero."""

    force: Vector
    moment: Vector


def compute_guide_force(tree: BatchedTree, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
    out = np.zeros((tree.robot.na, 3, len(q)))
    for part in iterate_blocks(len(q)):
        _fill(tree, out[:, :, part], q[part], v[part], a[part])
    return out.transpose(2, 0, 1)


def compute_passive_rates(tree: BatchedTree, pairs: tuple[BearingPair, ...], q: np.ndarray) -> np.ndarray:
    """Return how fast passive bearings turn per actuated speed (N, n, 3, na); see `loops.py`."""
    out = np.zeros((len(pairs), 3, tree.robot.na, len(q)))
    for part in iterate_blocks(len(q) if pairs else 0):
        closed = tree.loops.close(q[part])
        turns = {j.v: closed.at.axis[j.index][:, None] * closed.G[j.v] for j in tree.joints if not j.slides}
        for k, pair in enumerate(pairs):
            if pair.hinge is not None:
                out[k, 0, :, part] = closed.G[pair.hinge]
                continue
            for index in np.flatnonzero(pair.weights).tolist():
                if index in turns:
                    out[k, :, :, part] += pair.weights[index] * turns[index]
    return out.transpose(3, 0, 1, 2)


def _fill(tree: BatchedTree, out: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
    closed, moving = tree.moving(q, v, a)
    inertial = {link.joint_id: _inertial(tree, closed, moving, link.joint_id) for link in tree.robot.links}
    pulls = _pulls(tree, closed, inertial)
    model = tree.solver.model
    for i, (name, kind) in enumerate(zip(tree.robot.actuated, tree.robot.joint_kinds, strict=True)):
        if kind != "prismatic":
            continue
        own = model.getJointId(name)
        inside = [j.index for j in tree.joints if own in model.supports[j.index].tolist()]
        beyond = np.zeros((3, len(q)))
        for j in inside:
            beyond += pulls.get(j, 0.0)
            if j != own:
                needed = inertial[j].force if j in inertial else None
                beyond -= 0.0 if needed is None else needed
                beyond += sum(w.mass for w in tree.weights if w.joint == j) * tree.gravity[:, None]
        axis = closed.at.axis[own]
        out[i] = beyond - (beyond * axis).sum(axis=0) * axis


def _inertial(tree: BatchedTree, closed: ClosedLoops, moving: FrameMotion, joint: int) -> _Load:
    """Return what accelerates and carries a body."""
    rotation = closed.at.rotation[joint]

    def own(x: Vector) -> Vector:
        return None if x is None else rotate_into_frame(rotation, x)

    blank = np.zeros((3, 0, rotation.shape[2]))
    a, w, dw = moving.acceleration[joint], moving.turning[joint], moving.spinning_up[joint]
    force, moment = compute_body_wrench(
        BodyMotion(np.zeros(0, int), blank, None, own(a), own(w), own(dw)), tree.pi[joint]
    )
    back = rotation.transpose(1, 0, 2)
    return _Load(*(None if x is None else rotate_into_frame(back, x) for x in (force, moment)))


def _pulls(tree: BatchedTree, closed: ClosedLoops, inertial: dict[int, _Load]) -> dict[int, np.ndarray]:
    """Return the loops' forces (3, N) on the joints' bodies they end on."""
    found: dict[int, np.ndarray] = {}
    if not tree.robot.loops:
        return found
    tau = _open_tree(tree, closed, inertial)[tree.solver.passive_v]
    forces = closed.inverse.solve_transposed(tau).reshape(len(tree.robot.loops), 3, -1)
    for loop, force in zip(tree.robot.loops, forces, strict=True):
        for frame, sign in ((loop.frame_a, 1.0), (loop.frame_b, -1.0)):
            joint = tree.solver.model.frames[frame].parentJoint
            found[joint] = found.get(joint, 0.0) + sign * force
    return found


def _open_tree(tree: BatchedTree, closed: ClosedLoops, inertial: dict[int, _Load]) -> np.ndarray:
    """Return the tree's joint forces (nv, N) with all loops cut: the recursion from the tips to the base."""
    at, n = closed.at, closed.x.shape[1]
    force: list[Vector] = [None] * (len(tree.joints) + 1)
    moment: list[Vector] = [None] * (len(tree.joints) + 1)
    for joint, load in inertial.items():
        force[joint], moment[joint] = load
    for weight in tree.weights:
        held = np.repeat(-weight.mass * tree.gravity[:, None], n, axis=1)
        arm = transform_point(at, weight.joint, weight.local) - at.origin[weight.joint]
        force[weight.joint] = add_vectors(force[weight.joint], held)
        moment[weight.joint] = add_vectors(moment[weight.joint], compute_cross_product(arm, held))
    tau = np.zeros((tree.solver.model.nv, n))
    for joint in reversed(tree.joints):
        f, m = force[joint.index], moment[joint.index]
        acting = f if joint.slides else m
        if acting is not None:
            tau[joint.v] = (at.axis[joint.index] * acting).sum(axis=0)
        arm = at.origin[joint.index] - at.origin[joint.parent]
        force[joint.parent] = add_vectors(force[joint.parent], f)
        moment[joint.parent] = add_vectors(moment[joint.parent], add_vectors(m, compute_cross_product(arm, f)))
    return tau


_FEW = 12
"""Samples up to which one by one is quicker."""


class TreeMechanism(SamplewiseTree):
    """Dynamics of a tree with loops."""

    def __init__(self, robot: Robot) -> None:
        """Prepare for the robot's parameter values."""
        super().__init__(robot)
        self._batched = BatchedTree.of(robot, self.solver)

    def _many(self, q: np.ndarray) -> BatchedTree | None:
        """Return the batched dynamics where these positions (N, na) are many enough."""
        return self._batched if np.ndim(q) == 2 and len(q) > _FEW else None

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p); see `Mechanism.regressor`."""
        batched = self._many(q)
        return super().regressor(q, v, a) if batched is None else batched.regressor(*self._checked(q, v, a))

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); see `Mechanism.inverse_dynamics`."""
        batched = self._many(q)
        return (
            super().inverse_dynamics(q, v, a) if batched is None else batched.inverse_dynamics(*self._checked(q, v, a))
        )

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na); see `Mechanism.inertia`."""
        batched = self._many(q)
        return super().inertia(q) if batched is None else batched.inertia(*self._checked(q))

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
        batched = self._many(q)
        return (
            super().guide_force(q, v, a) if batched is None else compute_guide_force(batched, *self._checked(q, v, a))
        )

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn (N, n, 3, na); see `Mechanism.passive_rates`."""
        batched = self._many(q)
        if batched is None:
            return super().passive_rates(q)
        return tuple(pair.name for pair in self._pairs), compute_passive_rates(batched, self._pairs, *self._checked(q))

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m]; see `Mechanism.tool_position`."""
        batched = self._many(q)
        if batched is None or self.robot.tool_frame is None:
            return super().tool_position(q)
        return batched.tool(*self._checked(q))[0]

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per actuated speed (N, 3, na); see `Mechanism.tool_jacobian`."""
        batched = self._many(q)
        if batched is None or self.robot.tool_frame is None:
            return super().tool_jacobian(q)
        return batched.tool(*self._checked(q))[1]

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,); see `Mechanism.condition`."""
        batched = self._many(q)
        if batched is None or not self.robot.loops:
            return super().condition(q)
        (q,) = self._checked(q)
        found = []
        for part in iterate_blocks(len(q)):
            J = batched.loops.jacobian(batched.loops.close(q[part]).at)
            s = np.linalg.svd(J / measure_column_lengths(J)[:, None, :], compute_uv=False)
            singular = s[:, -1] <= 1e-10 * s[:, 0]
            found.append(np.divide(s[:, 0], s[:, -1], out=np.full(len(s), np.inf), where=~singular))
        return np.concatenate(found)


def build_mechanism(robot: Robot) -> Mechanism:
    """Return the fastest exact dynamics for a robot: the closed form where its file declares one that holds, else Pinocchio.

    It holds where rods are slender, sit on the carts' origins and follow their masses; one sample near home shows it. Dynamics
    remember the last closure, so every call makes its own; its kinematics are kept beside the robot (`build_kinematics`).
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
