"""The recursive Newton-Euler algorithm of a tree with its loops cut, link by link in each link's own axes.

Outwards, with `R` and `p` the place of a joint in its parent and `u` its axis,

    w = R' w_p + u qd,   w' = R' w_p' + (R' w_p) x u qd + u qdd,   c = R' (c_p + w_p' x p + w_p x (w_p x p)),

and for a slide `c += u qdd + 2 w x u qd`, where `c` starts as minus gravity. Inwards, about the joint's origin, with the
link's mass m, first moment s and inertia I,

    f = m c + w' x s + w x (w x s) + children's,   n = I w' + w x I w + s x c + children's,   tau = u . n  or  u . f.

Arrays have samples last and hold numbers, or expressions of one sample. Reference: Luh, Walker & Paul 1980; Khalil & Dombre
2002, 9.5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.mechanism.frames import (
    Joint,
    Vector,
    add_vectors,
    compute_cross_product,
    remove_rounding,
    rotate_into_frame,
    turn_frames,
)
from tau_dyn.robot import Robot, compute_inertia_matrix


class Weight(NamedTuple):
    """A mass that only gravity acts on.

    Attributes:
        column: Among the parameters.
        frame: Index of its link's frame.
        joint: Index of the joint that carries it.
        local: Its place in that joint's frame (3,) [m].
        mass: Its value [kg].
    """

    column: int
    frame: int
    joint: int
    local: np.ndarray
    mass: Any


def list_inertial_numbers(robot: Robot, value: Callable[[str], Any]) -> dict[int, np.ndarray]:
    """Return ten inertial numbers of each link, by its joint's index; `value` gives a parameter by its name."""
    return {link.joint_id: link.map @ np.array([value(name) for name in link.names]) for link in robot.links}


def list_weights(robot: Robot, value: Callable[[str], Any]) -> list[Weight]:
    """Return the masses that only gravity acts on; `value` gives a parameter by its name."""
    found, model = [], robot.model
    for column, name in enumerate(robot.parameters.names):
        if name.endswith(".gravity_mass"):
            index = model.getFrameId(name.rsplit(".", 1)[0])
            frame = model.frames[index]
            found.append(Weight(column, index, int(frame.parentJoint), frame.placement.translation.copy(), value(name)))
    return found


class LinkMotion(NamedTuple):
    """A link's motion in its own axes: turning `w`, its change `dw` and the acceleration `c` of its origin minus gravity.

    `R` (3, 3, N) and `p` (3, N) lead from its axes to its parent's.
    """

    w: Vector
    dw: Vector
    c: Vector
    R: np.ndarray
    p: np.ndarray


class TreeForces(NamedTuple):
    """Forces in a tree with its loops cut.

    Attributes:
        tau: The joints' forces (nv, N), without drive inertia.
        beyond: Force of the links beyond each joint's own link on that link, in its axes (3, N), by Pinocchio's index.
    """

    tau: np.ndarray
    beyond: list[Vector]


def compute_link_motions(
    joints: Sequence[Joint], x: np.ndarray, v: Vector, a: np.ndarray, gravity: np.ndarray
) -> list[LinkMotion]:
    """Return the links' motions by Pinocchio's index, that of the world first.

    Args:
        joints: The tree.
        x: Positions of its joints (nv, N) [m or rad].
        v: Velocities (nv, N), or None for rest.
        a: Accelerations (nv, N).
        gravity: In base axes (3,) [m/s^2].
    """
    n = x.shape[1]
    lift = -gravity[:, None] if gravity.any() else None
    found = [LinkMotion(None, None, lift, np.eye(3)[:, :, None], np.zeros((3, 1)))]
    for joint in joints:
        above, u, p = found[joint.parent], joint.axis[:, None], remove_rounding(joint.offset)[:, None]
        R = joint.rotation[:, :, None]
        if joint.slides:
            p = p + remove_rounding(joint.rotation @ joint.axis)[:, None] * x[joint.v]
        else:
            R = turn_frames(np.broadcast_to(R, (3, 3, n)), joint, x[joint.v])
        c = add_vectors(above.c, compute_cross_product(above.dw, p))
        c = add_vectors(c, compute_cross_product(above.w, compute_cross_product(above.w, p)))
        w, dw, c = (None if vector is None else rotate_into_frame(R, vector) for vector in (above.w, above.dw, c))
        rate, gain = None if v is None else u * v[joint.v], u * a[joint.v]
        across = compute_cross_product(w, rate)
        if joint.slides:
            c = add_vectors(c, add_vectors(None if across is None else 2.0 * across, gain))
        else:
            w, dw = add_vectors(w, rate), add_vectors(dw, add_vectors(across, gain))
        found.append(LinkMotion(w, dw, c, R, p))
    return found


def compute_link_wrench(motion: LinkMotion, pi: np.ndarray) -> tuple[Vector, Vector]:
    """Return the force and the moment (3, N) about its origin that a link of ten inertial numbers needs for its motion."""
    w, dw, c = motion.w, motion.dw, motion.c
    s = pi[1:4, None] if pi.dtype == object or pi[1:4].any() else None
    f = None if c is None else c * pi[0]  # an array times an expression, which takes no arrays itself
    f = add_vectors(f, compute_cross_product(dw, s))
    f = add_vectors(f, compute_cross_product(w, compute_cross_product(w, s)))
    inertia = compute_inertia_matrix(pi)
    moment = None if dw is None else inertia @ dw
    moment = add_vectors(moment, None if w is None else compute_cross_product(w, inertia @ w))
    return f, add_vectors(moment, compute_cross_product(s, c))


def compute_tree_forces(
    joints: Sequence[Joint],
    state: tuple[np.ndarray, Vector, np.ndarray],
    pi: Mapping[int, np.ndarray],
    weights: Sequence[Weight],
    gravity: np.ndarray,
) -> TreeForces:
    """Return the forces of a tree with its loops cut.

    Args:
        joints: The tree.
        state: Positions, velocities (None for rest) and accelerations of its joints, each (nv, N).
        pi: Ten inertial numbers of the links, by Pinocchio's index.
        weights: Masses that only gravity acts on.
        gravity: In base axes (3,) [m/s^2].
    """
    motions = compute_link_motions(joints, *state, gravity)
    f: list[Vector] = [None] * len(motions)
    n: list[Vector] = [None] * len(motions)
    for index, own in pi.items():
        f[index], n[index] = compute_link_wrench(motions[index], own)
    down = [gravity[:, None]]  # gravity in the links' axes
    for joint in joints if weights else ():
        down.append(rotate_into_frame(motions[joint.index].R, down[joint.parent]))
    for weight in weights:
        held = down[weight.joint] * -weight.mass
        f[weight.joint] = add_vectors(f[weight.joint], held)
        n[weight.joint] = add_vectors(n[weight.joint], compute_cross_product(weight.local[:, None], held))
    beyond: list[Vector] = [None] * len(motions)
    tau = np.zeros_like(state[0])
    for joint in reversed(joints):
        k, parent = joint.index, joint.parent
        acting = f[k] if joint.slides else n[k]
        if acting is not None:
            tau[joint.v] = (
                acting[joint.along] if joint.along is not None else (joint.axis[:, None] * acting).sum(axis=0)
            )
        if parent:
            back = motions[k].R.transpose(1, 0, 2)
            turned, lever = (None if x is None else rotate_into_frame(back, x) for x in (f[k], n[k]))
            beyond[parent] = add_vectors(beyond[parent], None if turned is None else -turned)
            f[parent] = add_vectors(f[parent], turned)
            n[parent] = add_vectors(n[parent], add_vectors(lever, compute_cross_product(motions[k].p, turned)))
    return TreeForces(tau, beyond)
