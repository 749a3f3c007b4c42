r"""Frames, rotations and motion of trees and of actuated chains for many samples at once: `(3, N)`, `(3, 3, N)`.

Every number is a row of N samples, so that NumPy works in long loops instead of in many calls. All vectors are in world
axes; a tree's joints have one degree of freedom, whose position is an angle or a length whatever Pinocchio's configuration is.
A zero motion is `None`, so that carts on rails cost no cross products. Reference: Featherstone 2008, ch. 4 and 5.

A joint of an actuated chain is at `o` in its parent's frame. A slide moves along `d`, a turn rotates by `Exp(q d)`; both
before the constant rotation `R_0` of its own frame:

    slide: p = o + q d, R = R_0;        turn: p = o, R = Exp(q d) R_0.

So the length of `d` is the drive's gain: 1 in a robot file, something else after a calibration. A quantity that does not depend
on `q` stays a constant `(3, 1)` or `(3, 3, 1)`. Reference: thesis (4.16) to (4.24).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, overload

import numpy as np
import pinocchio as pin

_AHEAD, _BEHIND = (1, 2, 0), (2, 0, 1)

Vector = np.ndarray | None
"""Components (3, N), or None for zero."""


class Joint(NamedTuple):
    """One joint of the tree.

    Attributes:
        index: Pinocchio's index.
        parent: Index of the parent joint, 0 for the world.
        rotation: Rotation (3, 3) of its frame in the parent's at position zero.
        offset: Where that is [m] (3,).
        axis: Direction (3,) in its own frame.
        along: Index of the frame's axis that `axis` is, or None for any other direction.
        slides: Whether it is prismatic.
        v: Index in the tree's velocity.
    """

    index: int
    parent: int
    rotation: np.ndarray
    offset: np.ndarray
    axis: np.ndarray
    along: int | None
    slides: bool
    v: int

    def place(self, q: float) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation (3, 3) and origin (3,) [m] of its frame in the parent's at a position [m or rad]."""
        axis, rotation = np.asarray(self.axis, float), np.asarray(self.rotation, float)
        if self.slides:
            return rotation, self.offset + rotation @ axis * q
        return rotation @ pin.exp3(axis * q), np.asarray(self.offset, float)


class Frames(NamedTuple):
    """Where all joints are, by Pinocchio's index: rotations (3, 3, N), origins (3, N) and axes (3, N)."""

    rotation: list[np.ndarray]
    origin: list[np.ndarray]
    axis: list[np.ndarray]


class FrameMotion(NamedTuple):
    """How all joints' frames move: angular velocity and acceleration, and the origin's acceleration, each a `Vector`."""

    turning: list[Vector]
    spinning_up: list[Vector]
    acceleration: list[Vector]


def list_joints(model: pin.Model) -> list[Joint] | None:
    """Return a model's joints, parents first, or None if one has more than one degree of freedom."""
    found = []
    for index in range(1, model.njoints):
        item, name = model.joints[index], model.joints[index].shortname().removeprefix("JointModel")
        if item.nv != 1 or not name.startswith(("R", "P")) or "Mimic" in name:
            return None
        way = compute_subspace(model, index)
        axis = remove_rounding(way[:3] if name.startswith("P") else way[3:])
        along = next((k for k in range(3) if axis[k] == 1.0), None)
        placement = model.jointPlacements[index]
        rotation, offset = remove_rounding(placement.rotation), placement.translation.copy()
        slides, v = name.startswith("P"), int(item.idx_v)
        found.append(Joint(index, int(model.parents[index]), rotation, offset, axis, along, slides, v))
    return found


def compute_subspace(model: pin.Model, joint: int) -> np.ndarray:
    """Return the twist (6,) of a joint of one degree of freedom in its own frame, linear first."""
    item = model.joints[joint]
    data = item.createData()  # of the joint alone: that of a chain of hundreds takes a second
    item.calc(data, pin.neutral(model))
    return np.asarray(data.S).reshape(6, -1)[:, 0]


def remove_rounding(x: np.ndarray) -> np.ndarray:
    """Return numbers with the rounding of whole ones taken away, so that zeros are seen as zeros; expressions stay."""
    return x if x.dtype == object else np.where(np.abs(x - np.round(x)) < 1e-15, np.round(x), x)


def compute_frames(joints: list[Joint], x: np.ndarray) -> Frames:
    """Return where all joints are at positions `x` (nv, N) [m or rad]."""
    n = x.shape[1]
    eye, zero = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, n)), np.zeros((3, n))
    rotation, origin, axis = [eye], [zero], [zero]
    for joint in joints:
        parent = rotation[joint.parent]
        base = multiply_by_rotation(parent, joint.rotation)
        here = base if joint.slides else turn_frames(base, joint, x[joint.v])
        along = here[:, joint.along] if joint.along is not None else combine_rotated(here, joint.axis)
        place = origin[joint.parent]
        if joint.offset.any():
            place = place + combine_rotated(parent, joint.offset)
        rotation.append(here)
        axis.append(along)
        origin.append(place + along * x[joint.v] if joint.slides else place)
    return Frames(rotation, origin, axis)


def compute_motion(
    joints: list[Joint], at: Frames, v: np.ndarray, a: np.ndarray | None, lift: np.ndarray
) -> FrameMotion:
    """Return how all joints' frames move.

    Args:
        joints: The tree.
        at: Where it is.
        v: Velocities (nv, N).
        a: Accelerations (nv, N), or None for zero.
        lift: Acceleration (3,) of the world, minus gravity for forces; zero for kinematics.
    """
    n = v.shape[1]
    turning: list[Vector] = [None]
    spinning: list[Vector] = [None]
    acceleration: list[Vector] = [np.repeat(lift[:, None], n, axis=1) if lift.any() else None]
    for joint in joints:
        w, dw, z = turning[joint.parent], spinning[joint.parent], at.axis[joint.index]
        arm = at.origin[joint.index] - at.origin[joint.parent]
        here = add_vectors(
            acceleration[joint.parent],
            add_vectors(compute_cross_product(dw, arm), compute_cross_product(w, compute_cross_product(w, arm))),
        )
        rate = z * v[joint.v]
        gain = None if a is None else z * a[joint.v]
        if joint.slides:
            across = compute_cross_product(w, rate)
            here = add_vectors(here, add_vectors(None if across is None else 2 * across, gain))
            turning.append(w)
            spinning.append(dw)
        else:
            turning.append(add_vectors(w, rate))
            spinning.append(add_vectors(dw, add_vectors(compute_cross_product(w, rate), gain)))
        acceleration.append(here)
    return FrameMotion(turning, spinning, acceleration)


def transform_point(at: Frames, joint: int, local: np.ndarray) -> np.ndarray:
    """Return a point (3, N) that a joint's frame carries at `local` (3,)."""
    return at.origin[joint] + combine_rotated(at.rotation[joint], local)


def yield_columns(
    at: Frames, joints: Iterable[Joint], place: np.ndarray
) -> Iterator[tuple[Joint, np.ndarray, np.ndarray | None]]:
    """Yield how a point (3, N) moves and turns with each joint's speed, both (3, N); None if it does not turn."""
    for joint in joints:
        axis = at.axis[joint.index]
        if joint.slides:
            yield joint, axis, None
        else:
            yield joint, compute_cross_product(axis, place - at.origin[joint.index]), axis


@overload
def compute_cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray: ...
@overload
def compute_cross_product(a: Vector, b: Vector) -> Vector: ...
def compute_cross_product(a: Vector, b: Vector) -> Vector:
    """Return `a x b` of components (3, ..., N), which must have as many axes, or (3,); None if one is zero."""
    if a is None or b is None:
        return None
    shape = a.shape if a.shape == b.shape else np.broadcast_shapes(a.shape, b.shape)
    symbols = a if a.dtype == object else b if b.dtype == object else None
    out = np.empty(shape, b.dtype) if symbols is None else np.empty_like(symbols, shape=shape, order="C")
    for k, row in enumerate(out if out.ndim > 1 else (out[k, ...] for k in range(3))):
        np.multiply(a[_AHEAD[k]], b[_BEHIND[k]], out=row)
        row -= a[_BEHIND[k]] * b[_AHEAD[k]]
    return out


@overload
def add_vectors(a: np.ndarray, b: Vector) -> np.ndarray: ...
@overload
def add_vectors(a: Vector, b: Vector) -> Vector: ...
def add_vectors(a: Vector, b: Vector) -> Vector:
    """Return `a + b`."""
    if a is None or b is None:
        return b if a is None else a
    return a + b


def rotate_into_frame(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return world vectors (3, ..., N) in a frame of rotation (3, 3, N), or each of one sample."""
    if rotation.dtype == object or rotation.shape[-1] > vector.shape[-1]:
        shape = np.broadcast_shapes(rotation.shape[1:], vector.shape)
        out = np.empty_like(rotation if rotation.dtype == object else vector, shape=shape, order="C")
    else:
        out = np.empty_like(vector)
    for k in range(3):
        np.multiply(rotation[0, k], vector[0], out=out[k])
        out[k] += rotation[1, k] * vector[1]
        out[k] += rotation[2, k] * vector[2]
    return out


def combine_rotated(rotation: np.ndarray, constant: np.ndarray) -> np.ndarray:
    """Return `R c` (3, N) of rotations (3, 3, N) and a constant (3,), without multiplying by zeros."""
    used = [k for k in range(3) if constant[k] != 0.0]
    if not used:
        return np.zeros((3, rotation.shape[2]))
    out = rotation[:, used[0]] * constant[used[0]]
    for k in used[1:]:
        out += rotation[:, k] * constant[k]
    return out


def multiply_by_rotation(rotation: np.ndarray, constant: np.ndarray) -> np.ndarray:
    """Return `R C` of rotations (3, 3, N) and a constant (3, 3)."""
    if np.array_equal(constant, np.eye(3)):
        return rotation
    return np.stack([combine_rotated(rotation, column) for column in constant.T], axis=1)


def turn_frames(base: np.ndarray, joint: Joint, angle: np.ndarray) -> np.ndarray:
    """Return a joint's frames (3, 3, N) turned about its axis by angles (N,) [rad]."""
    if joint.along is None:
        third = complete_axis(joint.axis)
        about_z = joint._replace(along=2)
        return multiply_by_rotation(turn_frames(multiply_by_rotation(base, third), about_z, angle), third.T)
    c, s, k = np.cos(angle), np.sin(angle), joint.along
    one, two = _AHEAD[k], _BEHIND[k]
    out = np.empty_like(angle, shape=base.shape)
    out[:, k] = base[:, k]
    out[:, one] = base[:, one] * c + base[:, two] * s
    out[:, two] = base[:, two] * c - base[:, one] * s
    return out


def complete_axis(axis: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) whose third column is this direction."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])


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


class JointFrame(NamedTuple):
    """A joint's frame: rotation (3, 3, N or 1), origin (3, N or 1), and `d` in the world (3, N or 1)."""

    rotation: np.ndarray
    origin: np.ndarray
    direction: np.ndarray


WORLD = JointFrame(np.eye(3)[:, :, None], np.zeros((3, 1)), np.zeros((3, 1)))


def compute_joint_frames(joints: Sequence[ChainJoint], q: np.ndarray) -> list[JointFrame]:
    """Return the frames of all joints at `q` (na, N)."""
    found: list[JointFrame] = []
    for joint in joints:
        parent = found[joint.parent] if joint.parent >= 0 else WORLD
        direction = rotate_vectors(parent.rotation, joint.direction)
        origin = parent.origin + rotate_vectors(parent.rotation, joint.origin)
        if joint.slides:
            here = JointFrame(
                multiply_by_constant(parent.rotation, joint.rotation), origin + direction * q[joint.actuator], direction
            )
        else:
            here = JointFrame(_rotated(parent.rotation, joint, q[joint.actuator]), origin, direction)
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
    if angle.dtype == object:  # so that symbols are not multiplied by rounding
        along, around, across = (remove_rounding(x) for x in (along, around, across))
    c, s = np.cos(gain * angle), np.sin(gain * angle)
    own = across[:, :, None] * c + around[:, :, None] * s + along[:, :, None]
    if parent.dtype != object and parent.shape[2] == 1 and np.array_equal(parent[:, :, 0], np.eye(3)):
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
    out = np.empty_like(q, shape=(len(carried.carrier), 3, q.shape[1]))
    for k, carrier in enumerate(carried.carrier):
        here = at[carrier] if carrier >= 0 else WORLD
        out[k] = here.origin + rotate_vectors(here.rotation, carried.local[k])
    return out


def compute_velocities(
    joints: Sequence[ChainJoint], carried: Carried, at: Sequence[JointFrame], places: np.ndarray
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


def compute_accelerations(joints: Sequence[ChainJoint], carried: Carried, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the points' accelerations (n, 3, N) at `q` and velocities `v` (na, N) without actuated acceleration."""
    x, rates = np.zeros_like(v), np.zeros_like(v)
    tree: list[Joint] = []
    for k, (_, parent, n, slides, origin, direction, rotation) in enumerate(joints):
        gain = float(np.linalg.norm(direction))
        axis = rotation.T @ direction / gain
        tree.append(Joint(k + 1, parent + 1, rotation, origin, axis, None, slides, n))
        x[n], rates[n] = gain * q[n], gain * v[n]
    at = compute_frames(tree, x)
    moving = compute_motion(tree, at, rates, None, np.zeros(3))
    out = np.zeros((len(carried.carrier), 3, q.shape[1]))
    for k, carrier in enumerate(carried.carrier):
        total = compute_point_acceleration(at, moving, carrier + 1, transform_point(at, carrier + 1, carried.local[k]))
        out[k] = 0.0 if total is None else total
    return out


def compute_point_acceleration(at: Frames, moving: FrameMotion, joint: int, place: np.ndarray) -> Vector:
    """Return the acceleration (3, N) of a point (3, N) that a joint carries."""
    arm, w = place - at.origin[joint], moving.turning[joint]
    swung = compute_cross_product(w, compute_cross_product(w, arm))
    return add_vectors(
        moving.acceleration[joint], add_vectors(compute_cross_product(moving.spinning_up[joint], arm), swung)
    )
