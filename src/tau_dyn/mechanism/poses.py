r"""Poses of a tool in the world, actuated positions as users give them, and the results of forward and inverse kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.frames import compute_cross_product
from tau_dyn.parameters import as_numbers
from tau_dyn.results import count
from tau_dyn.robot import Robot

_ROTATION = 1e-6  # largest departure of R'R from identity; numbers written with seven digits pass
_GIANT = 1e100
"""Largest difference of `R'R` from one, entry by entry, in a rotation that a user gives."""


class Poses(NamedTuple):
    """Where a frame is, in the world.

    Attributes:
        position: (N, 3) [m].
        rotation: Rotation matrices (N, 3, 3), columns the frame's axes.
    """

    position: np.ndarray
    rotation: np.ndarray

    def __repr__(self) -> str:
        """Return how many there are, and where the first is."""
        first = f", the first at {np.array2string(self.position[0], precision=6)} m" if len(self.position) else ""
        return f"Poses of {count(len(self.position), 'sample')}{first}"

    @property
    def n_samples(self) -> int:
        """Number of poses."""
        return len(self.position)

    def take(self, index: np.ndarray | slice) -> Poses:
        """Return the poses at an index, a mask or a slice."""
        return Poses(self.position[index], self.rotation[index])

    @classmethod
    def join(cls, parts: Sequence[Poses]) -> Poses:
        """Return the poses of all parts, one after the other; without parts, empty poses."""
        position, rotation = [p.position for p in parts], [p.rotation for p in parts]
        return cls(np.concatenate([np.zeros((0, 3)), *position]), np.concatenate([np.zeros((0, 3, 3)), *rotation]))

    def after(self, placement: pin.SE3) -> Poses:
        """Return the poses (N) of a frame that is fixed at `placement` in this one."""
        position = self.position
        if placement.translation.any():
            position = position + self.rotation @ placement.translation
        if np.array_equal(placement.rotation, np.eye(3)):
            return Poses(position, self.rotation)
        return Poses(position, self.rotation @ placement.rotation)


def convert_to_quaternions(poses: Poses) -> np.ndarray:
    """Return `x y z w` (N, 4) with `w >= 0`, as the columns qx_tool.. of a log; nan where a pose is.

    The longest column of `4 q q'`, which is linear in the rotation (Bar-Itzhack's method for exact rotations).
    """
    sound = np.isfinite(poses.rotation).all(axis=(1, 2), keepdims=True)
    R, outer = np.where(sound, poses.rotation, np.nan), np.empty((len(poses.rotation), 4, 4))
    trace = np.trace(R, axis1=1, axis2=2)
    outer[:, :3, :3] = R + np.swapaxes(R, 1, 2) + (1.0 - trace)[:, None, None] * np.eye(3)
    outer[:, :3, 3] = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    outer[:, 3, :3], outer[:, 3, 3] = outer[:, :3, 3], 1.0 + trace
    longest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q = np.take_along_axis(outer, longest[:, None, None], axis=1)[:, 0]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    first = q[np.arange(len(q)), np.where(q[:, 3] != 0, 3, np.argmax(q != 0, axis=1))]  # of a half turn the first axis
    return q * np.where(first < 0, -1.0, 1.0)[:, None]


def convert_from_quaternions(position: np.ndarray, quaternion: np.ndarray) -> Poses:
    """Return poses from positions (N, 3) [m] and quaternions `x y z w` (N, 4); nan stays nan.

    Raises:
        InputError: Arrays of the wrong shape, or a quaternion that is zero.
    """
    position = np.atleast_2d(np.asarray(position, float))
    quaternion = np.atleast_2d(np.asarray(quaternion, float))
    if position.shape[1:] != (3,) or quaternion.shape != (len(position), 4):
        raise InputError(
            "wrong_shape",
            "a pose is a position x y z and a quaternion x y z w; "
            f"the arrays have shapes {position.shape} and {quaternion.shape}",
        )
    size = np.max(np.abs(quaternion), axis=1, initial=0.0)
    if np.any(size < 1e-9):
        raise InputError(
            "bad_sample", f"the quaternion of pose {int(np.argmax(size < 1e-9)) + 1} is zero; it must have a direction"
        )
    rotation = np.full((len(position), 3, 3), np.nan)
    sound = np.isfinite(size)
    if sound.any():
        from scipy.spatial.transform import Rotation

        units = np.where(size > _GIANT, size, 1.0)  # of numbers whose squares are beyond a float
        rotation[sound] = Rotation.from_quat((quaternion / units[:, None])[sound]).as_matrix()
    return Poses(position, rotation)


def require_poses(poses: Poses) -> Poses:
    """Return poses as arrays of the right shape; one pose may come without its first axis.

    Raises:
        InputError: Wrong shapes, or matrices that are no rotations.
    """
    position = np.atleast_2d(np.asarray(poses.position, float))
    rotation = np.asarray(poses.rotation, float)
    rotation = rotation[None] if rotation.ndim == 2 else rotation
    if position.ndim != 2 or position.shape[1] != 3 or rotation.shape != (len(position), 3, 3):
        raise InputError(
            "wrong_shape",
            f"poses need positions (N, 3) and rotations (N, 3, 3), not {position.shape} and {rotation.shape}",
        )
    if rotation.strides[0] == 0:  # one rotation for all
        return Poses(position, _all_rotations(rotation[:1], len(position)))
    return Poses(position, _all_rotations(rotation, len(position)))


def _all_rotations(rotation: np.ndarray, n: int) -> np.ndarray:
    known = np.where(np.isfinite(rotation).all(axis=(1, 2), keepdims=True), rotation, np.eye(3))  # nan is no fault here
    off = np.abs(np.swapaxes(known, 1, 2) @ known - np.eye(3)).max(axis=(1, 2), initial=0.0)
    wrong = (off > _ROTATION) | (np.linalg.det(known) < 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise InputError(
            "invalid_value", f"the rotation of pose {k + 1} is not a rotation matrix: its columns must be orthonormal"
        )
    return np.broadcast_to(rotation, (n, 3, 3)) if len(rotation) == 1 else rotation


def require_positions(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return actuated positions as an array (N, na); one sample may come without its first axis.

    Raises:
        InputError: The array has another shape.
    """
    q = as_numbers(q, "positions")
    q = q[None] if q.ndim == 1 else q
    if q.ndim != 2 or q.shape[1] != robot.na:
        raise InputError(
            "wrong_shape",
            f"{robot.source} has {robot.na} actuated joints ({', '.join(robot.actuated)}); "
            f"positions must be (N, {robot.na}), not {q.shape}",
        )
    return q


OK, OUT_OF_REACH, SINGULAR, BRANCH_CHANGE, NO_CONVERGENCE, JOINT_LIMIT, NOT_A_NUMBER = range(7)

REASONS = np.array(
    ["", "out of reach", "singular", "branch change", "no convergence", "joint limit", "not a number"]
)  # fmt: skip
"""Reasons by code.

`out of reach`: no pose or no positions close the loops. `singular`: they do, but the mechanism has lost or gained a degree of
freedom there. `branch change`: the solution is beyond a singularity, in another assembly mode than home's or the start's.
`no convergence`: Newton's method did not converge; a solution may exist. `joint limit`: positions exist outside the file's
limits.
"""


class _Judged:
    """Samples with a code each."""

    code: np.ndarray

    def __repr__(self) -> str:
        """Return how many samples have a solution, and why the others do not."""
        why = [f"{np.sum(self.code == k)} {REASONS[k]}" for k in np.unique(self.code) if k != OK]
        return f"{type(self).__name__}: {np.sum(self.ok)} of {len(self.code)} answered{', '.join(['', *why])}"

    @property
    def ok(self) -> np.ndarray:
        """Whether a sample has a solution (N,)."""
        return self.code == OK

    @property
    def reason(self) -> np.ndarray:
        """Reason for a missing solution, '' with a solution (N,)."""
        return REASONS[self.code]


@dataclass(frozen=True, eq=False, repr=False)
class ForwardResult(_Judged):
    """Poses from actuated positions.

    Attributes:
        poses: Poses of the tool, nan without a solution.
        plate: Poses of the plate; for a robot without a plate, those of the tool.
        code: Index into `REASONS` (N,).
    """

    poses: Poses
    plate: Poses
    code: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class InverseResult(_Judged):
    """Actuated positions from poses.

    Attributes:
        q: Actuated positions (N, na) [m or rad], nan without a solution.
        code: Index into `REASONS` (N,).
        position_error: Distance of the tool from the requested pose (N,) [m]; nan without positions.
        orientation_error: Angle between the tool and the requested pose (N,) [rad]; above rounding only if the robot has too
            few degrees of freedom for that orientation.
        culprit: Actuated joints that caused the failure, '' without one (N,).
        unlimited: Positions before joint limits were looked at (N, na).
        rotation: Rotation that the tool takes there (N, 3, 3), the requested one if the robot can reach it; nan without
            `unlimited`.
    """

    q: np.ndarray
    code: np.ndarray
    position_error: np.ndarray
    orientation_error: np.ndarray
    culprit: np.ndarray
    unlimited: np.ndarray
    rotation: np.ndarray


class InverseSolutions(NamedTuple):
    """Solutions of each pose.

    Attributes:
        q: Positions (N, n, na); nan where complex, or to fill up.
        proved: Whether those of a pose are all there are (N,).
        why: The reason, a sentence a pose.
    """

    q: np.ndarray
    proved: np.ndarray
    why: list[str]


SLACK = 1e-9
"""Rounding at a joint limit [m or rad]."""


def unwind_turns(q: np.ndarray, turns: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return positions (N, na) with those outside their limits moved by a whole turn where that fits.

    Args:
        q: Positions (N, na) [m or rad], nan without a solution.
        turns: Which of the joints are turns that may be moved (na,).
        lower: Lower limits (na,).
        upper: Upper limits (na,).
    """
    q = q.copy()
    for k in np.flatnonzero(turns):
        for turn in (2 * np.pi, -2 * np.pi):
            outside = (q[:, k] < lower[k] - SLACK) | (q[:, k] > upper[k] + SLACK)
            moved = q[:, k] + turn
            fits = outside & (moved >= lower[k] - SLACK) & (moved <= upper[k] + SLACK)
            q[fits, k] = moved[fits]
    return q


def check_limits(robot: Robot) -> None:
    """Refuse limits that are the wrong way round.

    Raises:
        InputError: A lower limit is above its upper one.
    """
    for name, low, high in zip(robot.actuated, robot.lower, robot.upper, strict=True):
        if low > high:
            raise InputError(
                "robot_structure",
                f"{robot.source}: joint '{name}': its lower limit {low:g} is above its upper limit {high:g}",
            )


def refuse_beyond_limits(robot: Robot, found: InverseResult, limits: bool) -> InverseResult:
    """Return the positions with those outside joint limits refused; a turn may be a whole one away."""
    if not limits:
        return found
    turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
    q = unwind_turns(found.q, turns, robot.lower, robot.upper)
    with np.errstate(invalid="ignore"):
        beyond = np.any([q < robot.lower - SLACK, q > robot.upper + SLACK], axis=0)
    bad = beyond.any(axis=1)
    culprit = found.culprit.astype(object)
    for k in np.flatnonzero(bad):
        culprit[k] = " ".join(name for name, wrong in zip(robot.actuated, np.ravel(beyond[k]), strict=True) if wrong)
    code = np.where(bad, JOINT_LIMIT, found.code).astype(np.int8)
    allowed = np.where(bad[:, None], np.nan, q)
    lost = np.where(bad, np.nan, 1.0)
    return replace(
        found,
        q=allowed,
        code=code,
        position_error=found.position_error * lost,
        orientation_error=found.orientation_error * lost,
        culprit=culprit.astype(str),
        unlimited=q,
    )


def rotate_by_vector(w: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return `Exp(w) R` (3, 3, N) for rotation vectors (3, N), by Rodrigues' formula."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    s, c = _sine_and_cosine(square)
    out = np.empty(rotation.shape)
    for k in range(3):
        column = rotation[:, k]
        first = compute_cross_product(w, column)
        out[:, k] = compute_cross_product(w, first)
        out[:, k] *= c
        first *= s
        out[:, k] += first
        out[:, k] += column
    return out


def _sine_and_cosine(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `sin(x) / x` and `(1 - cos(x)) / x^2` (N,) of squared angles, by series where all are small."""
    if np.all(square < 0.01):  # the first terms left out are below 1e-13
        s = 1.0 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040)))
        return s, 0.5 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320)))
    small = square < 1e-6
    angle = np.sqrt(square)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.where(small, 1.0 - square / 6.0, np.sin(angle) / angle)
        c = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(angle)) / square)
    return s, c


def turn_rotations(w: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return `Exp(w) R` (N, 3, 3) for rotation vectors (N, 3) and rotations (N or 1, 3, 3)."""
    rotation = np.broadcast_to(rotation, (len(w), 3, 3))
    return np.moveaxis(rotate_by_vector(w.T, np.moveaxis(rotation, 0, 2)), 2, 0)


def measure_turns(rotation: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3) [rad], in world axes, that turn references (N or 1, 3, 3) into rotations (N, 3, 3)."""
    return log_of(np.moveaxis(rotation @ np.swapaxes(reference, 1, 2), 0, 2)).T


class StraightWay:
    """The straight ways from one pose to others: positions on lines, rotations about fixed axes.

    Attributes:
        home: Where they begin (1 sample).
        away: Displacements (N, 3) [m].
        turn: Rotation vectors (N, 3) [rad].
    """

    def __init__(self, home: Poses, goal: Poses, *, turns: bool = True) -> None:
        """Measure the ways to goals (N); without `turns` the rotation stays home's."""
        self.home, self.away = home, goal.position - home.position
        self.turn = np.nan_to_num(measure_turns(goal.rotation, home.rotation)) * turns

    def measure(self, unit: float) -> np.ndarray:
        """Return how long the ways are (N,), in a unit [m] or rad."""
        return np.maximum(np.linalg.norm(self.away, axis=1) / unit, np.abs(self.turn).max(axis=1))

    def at(self, share: float | np.ndarray, index: np.ndarray | slice = slice(None)) -> Poses:
        """Return the poses at a share of the ways, or one each (N,), of those at an index."""
        share = np.reshape(share, (-1, 1))
        turned = turn_rotations(share * self.turn[index], self.home.rotation)
        return Poses(self.home.position + share * self.away[index], turned)


def log_of(rotation: np.ndarray) -> np.ndarray:
    """Return rotation vectors (3, N) of rotations (3, 3, N)."""
    out = np.full((3, rotation.shape[2]), np.nan)
    sound = np.isfinite(rotation).all(axis=(0, 1))
    if sound.any():
        from scipy.spatial.transform import Rotation

        out[:, sound] = Rotation.from_matrix(np.moveaxis(rotation[:, :, sound], 2, 0)).as_rotvec().T
    return out
