"""Poses of a tool or plate in the world, many at once, and their quaternions as logs spell them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError

_ROTATION = 1e-6  # largest departure of R'R from identity; numbers written with seven digits pass
_GIANT = 1e100
"""What `R'R` may differ from one, entry by entry, in a rotation that a user gives."""


class Poses(NamedTuple):
    """Where a frame is, in the world.

    Attributes:
        position: (N, 3) [m].
        rotation: Rotation matrices (N, 3, 3), columns the frame's axes.
    """

    position: np.ndarray
    rotation: np.ndarray

    @property
    def n_samples(self) -> int:
        """Number of poses."""
        return len(self.position)

    def take(self, index: np.ndarray | slice) -> Poses:
        """Return the poses at an index, a mask or a slice."""
        return Poses(self.position[index], self.rotation[index])

    def after(self, placement: pin.SE3) -> Poses:
        """Return the poses (N) of a frame that sits at `placement` in this one."""
        position = self.position
        if placement.translation.any():
            position = position + self.rotation @ placement.translation
        if np.array_equal(placement.rotation, np.eye(3)):
            return Poses(position, self.rotation)
        return Poses(position, self.rotation @ placement.rotation)


def convert_to_quaternions(poses: Poses) -> np.ndarray:
    """Return `x y z w` (N, 4) with `w >= 0`, as the columns qx_tool.. of a log; nan where a pose is."""
    out = np.full((len(poses.position), 4), np.nan)
    sound = np.isfinite(poses.rotation).all(axis=(1, 2))
    if sound.any():
        out[sound] = Rotation.from_matrix(poses.rotation[sound]).as_quat(canonical=True)
    return out


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
