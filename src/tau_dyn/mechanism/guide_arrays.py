r"""What joints carry inside a mechanism, for many samples at once: forces across guideways, and how bearings turn.

No drive holds the passive joints, so the loops' forces `lambda` do: `J_p' lambda = tau_p`, where `tau_p` are the forces that
the open tree would need there. What everything beyond a slide's own link puts on that link is then the loops' pulls on its
subtree less what accelerates and carries the bodies behind it. Moments do not pass into it. All in world axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.batched import BatchedTree, iterate_blocks
from tau_dyn.mechanism.body_columns import BodyMotion, compute_body_wrench
from tau_dyn.mechanism.loop_arrays import ClosedLoops
from tau_dyn.mechanism.pairs import BearingPair
from tau_dyn.mechanism.tree_arrays import (
    FrameMotion,
    Vector,
    add_vectors,
    compute_cross_product,
    rotate_into_frame,
    transform_point,
)


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
    """Return how fast passive bearings turn per actuated speed (N, n, 3, na); see `pairs.py`."""
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
