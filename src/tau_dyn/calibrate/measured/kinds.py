r"""Kinds of measurement of the target by a device or a fixture: its place, its distance, or a touch.

    pose      the position, perhaps with the orientation, in the frame of a tracker or a camera
    hand_eye  the pose of the stationary target, in the frame of a camera on the tool: R^T, -R^T p
    distance  d = |p| + offset, from a stationary point: wire, ball bar, laser interferometer
    hole      p = 0: a pin is in a hole, at any attitude
    plane     p_z = 0: a probe touches a plane
    sphere    |p| = radius: a probe touches a ball
    angle     an encoder of a passive joint of a loop, r (psi + zero): the arc at the radius r
    travel    the same of a passive slide

`p` is the target in the frame of the device or fixture; for an encoder, the joint's arc or travel along x. Kinds with one number
measure along one direction `u`: `p / |p|`, z of a plane, or x of an encoder. The residual is a vector along `u`, and derivatives
are projected onto `u`. So all kinds have three coordinates a pose, and noise that is equal along all axes needs no other
treatment. Reference: Hollerbach, Khalil & Gautier 2016, 6.2 (partial poses).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism import Poses


class MeasurementKind(NamedTuple):
    """One kind of measurement.

    Attributes:
        numbers: Independent numbers of a position.
        axes: Coordinates of the device's frame that it determines: x, y, z, rx, ry, rz.
        length: Name of the length that it needs, '' if it needs no length.
        sign: Sign of that length in the residual.
        unit: Unit of that length.
    """

    numbers: int
    axes: tuple[int, ...]
    length: str = ""
    sign: float = 0.0
    unit: str = "m"


KINDS = {
    "pose": MeasurementKind(3, (0, 1, 2, 3, 4, 5)),
    "hand_eye": MeasurementKind(3, (0, 1, 2, 3, 4, 5)),
    "distance": MeasurementKind(1, (0, 1, 2), "offset", -1.0),
    "hole": MeasurementKind(3, (0, 1, 2)),
    "plane": MeasurementKind(1, (2, 3, 4)),
    "sphere": MeasurementKind(1, (0, 1, 2), "radius", 1.0),
    "angle": MeasurementKind(1, (), "zero", -1.0, "rad"),
    "travel": MeasurementKind(1, (), "zero", -1.0),
}
TOUCHES = ("hole", "plane", "sphere")
"""Kinds whose reading is always zero."""
ENCODERS = ("angle", "travel")
"""Kinds that measure a joint and not the tool."""


def find_directions(kinds: Sequence[str], device: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the direction (N, 3) of each measurement of one number, zero for those of all three coordinates.

    Args:
        kinds: Kind of each device or fixture.
        device: Index of the device or fixture of each measurement (N,).
        seen: Predicted positions of the target in the frames of devices or fixtures (N, 3).
    """
    out = np.zeros_like(seen)
    for number, name in enumerate(kinds):
        own = device == number
        if name == "plane":
            out[own, 2] = 1.0
        elif name in ENCODERS:
            out[own, 0] = 1.0
        elif KINDS[name].numbers == 1:
            out[own] = seen[own] / np.maximum(np.linalg.norm(seen[own], axis=1, keepdims=True), 1e-300)
    return out


def compute_position_residuals(
    kinds: Sequence[str], device: np.ndarray, measured: np.ndarray, seen: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """Return measured minus predicted (N, 3) [m], along the direction of the measurement if it has one.

    Args:
        kinds: Kind of each device or fixture.
        device: Index of the device or fixture of each measurement (N,).
        measured: Positions (N, 3) [m]; a distance is in the first coordinate.
        seen: Predicted positions of the target in the frames of devices or fixtures (N, 3) [m].
        lengths: Offset or radius of each measurement (N,) [m].
    """
    u = find_directions(kinds, device, seen)
    sign = np.array([KINDS[name].sign for name in kinds])[device]
    along = measured[:, 0] + sign * lengths - np.sum(u * seen, axis=1)
    one = np.any(u != 0, axis=1)
    return np.where(one[:, None], along[:, None] * u, measured - seen)


def invert_poses(poses: Poses) -> Poses:
    """Return the inverse `R^T, -R^T p` of poses (N)."""
    back = np.swapaxes(poses.rotation, 1, 2)
    return Poses(-np.einsum("nij,nj->ni", back, poses.position), back)


def invert_columns(poses: Poses, columns: np.ndarray) -> np.ndarray:
    """Return twists (N, 6, p) of the inverse of poses (N) from those of the poses: `R^T (w x p - v)` and `-R^T w`."""
    linear, angular = columns[:, :3], columns[:, 3:]
    back = np.swapaxes(poses.rotation, 1, 2)
    lever = np.cross(angular, poses.position[:, :, None], axis=1)
    return np.concatenate([back @ (lever - linear), -(back @ angular)], axis=1)


def project_columns(kinds: Sequence[str], device: np.ndarray, seen: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return derivatives (N, m, p) of the measured quantity from those of the whole position; rows of position come first.

    Args:
        kinds: Kind of each device or fixture.
        device: Index of the device or fixture of each measurement (N,).
        seen: Predicted positions of the target in the frames of devices or fixtures (N, 3) [m].
        columns: Derivatives of position and perhaps orientation (N, m, p).
    """
    if all(KINDS[name].numbers > 1 for name in kinds):
        return columns
    u = find_directions(kinds, device, seen)
    along = np.einsum("ni,nip->np", u, columns[:, :3])
    one = np.any(u != 0, axis=1)[:, None, None]
    position = np.where(one, u[:, :, None] * along[:, None], columns[:, :3])
    return np.concatenate([position, columns[:, 3:]], axis=1)
