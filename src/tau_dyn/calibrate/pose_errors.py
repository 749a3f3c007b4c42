"""How far measured poses are from predicted ones: vectors, and the mean, rms and largest of their sizes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import compute_rotation_between
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.mechanism import Poses


class ErrorSize(NamedTuple):
    """Mean, root mean square and largest of the errors' norms [m or rad]."""

    mean: float
    rms: float
    max: float

    def to_dict(self) -> dict[str, float]:
        """Return it as the contract spells it."""
        return {"mean": self.mean, "rms": self.rms, "max": self.max}


class PoseErrors(NamedTuple):
    """Measured minus predicted.

    Attributes:
        position: (N, 3) [m] in the device's axes, nan where the model reaches no pose.
        rotation: Rotation vectors (N, 3) [rad] in the device's axes, None where no orientation was measured.
    """

    position: np.ndarray
    rotation: np.ndarray | None

    @property
    def distance(self) -> np.ndarray:
        """Absolute positioning error (N,) [m], thesis (5.5)."""
        return np.linalg.norm(self.position, axis=1)

    @property
    def angle(self) -> np.ndarray | None:
        """Angle of the orientation error (N,) [rad]."""
        return None if self.rotation is None else np.linalg.norm(self.rotation, axis=1)

    def to_dict(self) -> dict[str, object]:
        """Return the contract's `{position, orientation}`; orientation is None where none was measured."""
        angle = self.angle
        return {
            "position": _size(self.distance).to_dict(),
            "orientation": None if angle is None else _size(angle).to_dict(),
        }

    @property
    def position_size(self) -> ErrorSize:
        """Mean, rms and largest positioning error [m]."""
        return _size(self.distance)

    @property
    def orientation_size(self) -> ErrorSize | None:
        """Mean, rms and largest orientation error [rad]."""
        angle = self.angle
        return None if angle is None else _size(angle)


def compute_pose_errors(poses: PoseSet, seen: Poses, target: np.ndarray | None, *, own: bool) -> PoseErrors:
    """Return measured minus predicted poses.

    Args:
        poses: What was measured.
        seen: What the device should have seen.
        target: Orientation of the target on a plate that keeps its own (3, 3).
        own: Whether the prediction has an orientation of its own.
    """
    position = poses.position - seen.position
    if poses.rotation is None or not (own or target is not None):
        return PoseErrors(position, None)
    predicted = seen.rotation if target is None else seen.rotation @ target
    rotation = np.full_like(position, np.nan)
    ok = np.isfinite(predicted).all(axis=(1, 2))
    rotation[ok] = compute_rotation_between(poses.rotation[ok], predicted[ok])
    return PoseErrors(position, rotation)


def _size(x: np.ndarray) -> ErrorSize:
    x = x[np.isfinite(x)]
    if not len(x):
        return ErrorSize(float("nan"), float("nan"), float("nan"))
    return ErrorSize(float(x.mean()), float(np.sqrt(np.mean(x**2))), float(x.max()))
