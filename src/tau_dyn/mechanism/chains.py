r"""Actuated chains and the points they carry, for many samples at once; arrays have components first and samples last.

A joint sits at `o` in its parent's frame. A slide moves along `d`, a turn rotates by `Exp(q d)`; both before the constant
rotation `R_0` of its own frame:

    slide: p = o + q d, R = R_0;        turn: p = o, R = Exp(q d) R_0.

So the length of `d` is the drive's gain: 1 in a robot file, something else after a calibration. What does not depend on
`q` stays a constant `(3, 1)` or `(3, 3, 1)`, so that carts on rails cost next to nothing. Reference: thesis (4.16) to
(4.24).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.tree_arrays import combine_rotated, compute_cross_product, multiply_by_rotation


class ChainJoint(NamedTuple):
    """One actuated joint.

    Attributes:
        name: Joint name.
        parent: Index of the joint before in the list, -1 for the world.
        actuator: Index in `q`.
        slides: Whether it is prismatic.
        origin: `o` (3,) [m] in the parent's frame.
        direction: `d` (3,) in the parent's frame.
        rotation: `R_0` (3, 3).
    """

    name: str
    parent: int
    actuator: int
    slides: bool
    origin: np.ndarray
    direction: np.ndarray
    rotation: np.ndarray


class Placed(NamedTuple):
    """A joint's frame: rotation (3, 3, N or 1), origin (3, N or 1), and `d` in the world (3, N or 1)."""

    rotation: np.ndarray
    origin: np.ndarray
    direction: np.ndarray


WORLD = Placed(np.eye(3)[:, :, None], np.zeros((3, 1)), np.zeros((3, 1)))


def compute_joint_frames(joints: Sequence[ChainJoint], q: np.ndarray) -> list[Placed]:
    """Return the frames of all joints at `q` (na, N)."""
    found: list[Placed] = []
    for joint in joints:
        parent = found[joint.parent] if joint.parent >= 0 else WORLD
        direction = rotate_vectors(parent.rotation, joint.direction)
        origin = parent.origin + rotate_vectors(parent.rotation, joint.origin)
        if joint.slides:
            here = Placed(
                multiply_by_constant(parent.rotation, joint.rotation), origin + direction * q[joint.actuator], direction
            )
        else:
            here = Placed(_rotated(parent.rotation, joint, q[joint.actuator]), origin, direction)
        found.append(here)
    return found


def list_path(joints: Sequence[ChainJoint], carrier: int) -> list[int]:
    """Return the joints between the world and a carrier, that one included, first to last."""
    found = []
    while carrier >= 0:
        found.append(carrier)
        carrier = joints[carrier].parent
    return found[::-1]


def rotate_vectors(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return `R c` (3, N) of rotations (3, 3, N) and a constant (3,), without negative zeros."""
    return combine_rotated(rotation, vector) + 0.0


def multiply_by_constant(rotation: np.ndarray, constant: np.ndarray) -> np.ndarray:
    """Return `R C` (3, 3, N) of rotations (3, 3, N) and a constant (3, 3), without negative zeros unless `C` is one."""
    return rotation if np.array_equal(constant, np.eye(3)) else multiply_by_rotation(rotation, constant) + 0.0


def _rotated(parent: np.ndarray, joint: ChainJoint, angle: np.ndarray) -> np.ndarray:
    """Return `R_parent Exp(q d) R_0` (3, 3, N), as `c M1 + s M2 + M3` with constant matrices where the parent is constant."""
    gain = float(np.linalg.norm(joint.direction))
    n = joint.direction / gain
    along = np.outer(n, n) @ joint.rotation
    around, across = skew(n) @ joint.rotation, joint.rotation - along
    c, s = np.cos(gain * angle), np.sin(gain * angle)
    own = across[:, :, None] * c + around[:, :, None] * s + along[:, :, None]
    if parent.shape[2] == 1 and np.array_equal(parent[:, :, 0], np.eye(3)):
        return own
    return np.einsum("ijn,jkn->ikn", np.broadcast_to(parent, (3, 3, own.shape[2])), own)


def skew(x: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of `x cross`."""
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


class Carried(NamedTuple):
    """Points that chains carry: index of the carrying joint (-1 for the world) and place in its frame (n, 3) [m]."""

    carrier: tuple[int, ...]
    local: np.ndarray


def compute_points(joints: Sequence[ChainJoint], carried: Carried, q: np.ndarray) -> np.ndarray:
    """Return the points (n, 3, N) [m] at `q` (na, N)."""
    at = compute_joint_frames(joints, q)
    out = np.empty((len(carried.carrier), 3, q.shape[1]))
    for k, carrier in enumerate(carried.carrier):
        here = at[carrier] if carrier >= 0 else WORLD
        out[k] = here.origin + rotate_vectors(here.rotation, carried.local[k])
    return out


def compute_velocities(
    joints: Sequence[ChainJoint], carried: Carried, at: Sequence[Placed], places: np.ndarray
) -> dict[tuple[int, int], np.ndarray]:
    """Return how points (n, 3, N) move per actuator: those of `(point, actuator)` that are not zero, each (3, N or 1)."""
    found: dict[tuple[int, int], np.ndarray] = {}
    for k, carrier in enumerate(carried.carrier):
        for index in list_path(joints, carrier):
            joint, here = joints[index], at[index]
            column: np.ndarray = here.direction
            if not joint.slides:
                arm: np.ndarray = places[k] - here.origin
                axis: np.ndarray = np.broadcast_to(here.direction, arm.shape)
                column = compute_cross_product(axis, arm)
            key = (k, joint.actuator)
            found[key] = found[key] + column if key in found else column
    return found


def compute_accelerations(
    joints: Sequence[ChainJoint], carried: Carried, at: Sequence[Placed], places: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Return the points' accelerations (n, 3, N) at velocities `v` (na, N) without actuated acceleration."""
    out = np.zeros(places.shape)
    for k, carrier in enumerate(carried.carrier):
        w, total = np.zeros(places[k].shape), np.zeros(places[k].shape)
        steps = [joints[i] for i in list_path(joints, carrier)]
        heres = [at[i] for i in list_path(joints, carrier)]
        if all(joint.slides for joint in steps):
            continue
        # outward: acceleration of each joint's origin, then of the point (Featherstone, ch. 2.11)
        origin, spin = np.zeros((3, 1)), np.zeros(places[k].shape)
        for joint, here in zip(steps, heres, strict=True):
            arm = here.origin - origin
            total = (
                total
                + compute_cross_product(spin, _wide(arm, w))
                + compute_cross_product(w, compute_cross_product(w, _wide(arm, w)))
            )
            rate = _wide(here.direction * v[joint.actuator], w)
            if joint.slides:
                total = total + 2 * compute_cross_product(w, rate)
            else:
                spin = spin + compute_cross_product(w, rate)
                w = w + rate
            origin = here.origin
        arm = _wide(places[k] - origin, w)
        out[k] = total + compute_cross_product(spin, arm) + compute_cross_product(w, compute_cross_product(w, arm))
    return out


def _wide(x: np.ndarray, like: np.ndarray) -> np.ndarray:
    return np.broadcast_to(x, like.shape)
