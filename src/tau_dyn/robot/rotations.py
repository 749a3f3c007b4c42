"""Rotations as robot files write them, and as Pinocchio's reader takes them: roll, pitch and yaw about fixed axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def build_rotation(rpy: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of roll, pitch and yaw [rad] about the fixed axes x, y, z, in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def compute_rpy(rotation: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw [rad] of a rotation (3, 3), as accurate beside a pitch of 90 degrees as elsewhere."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1])
    return np.array([roll, pitch, yaw])


def combine_axes(along: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) whose x axis points along a direction (3,)."""
    x = np.asarray(along, float) / np.linalg.norm(along)
    across = np.cross(x, np.eye(3)[int(np.argmin(np.abs(x)))])
    y = across / np.linalg.norm(across)
    return np.stack([x, y, np.cross(x, y)], axis=1)
