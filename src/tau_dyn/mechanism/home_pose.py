"""The plate's pose at home for another geometry: Newton on the rods, from the pose of the geometry before."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism.plate_arrays import rotate_by_vector
from tau_dyn.mechanism.poses import Poses

if TYPE_CHECKING:
    from tau_dyn.mechanism.rods import Rods

_CLOSED = 1e-12  # relative to the rods
_MAX_ITERATIONS = 30  # Newton steps from the file's pose
_STEP = 0.2  # of the rods' length or rad


def solve_pose_at_home(rods: Rods, start: Poses) -> Poses:
    """Return the plate's pose (1 sample) at the robot's home positions.

    Args:
        rods: The robot, perhaps at other geometric values than those of its file.
        start: Where to begin.

    Raises:
        LoopClosureError: The rods cannot be closed at home.
    """
    home, scale, pose, before = rods.robot.home[None], float(np.mean(rods.lengths)), start, np.inf
    for _ in range(_MAX_ITERATIONS):
        gap = rods.gap(home, pose)[0]
        size = float(np.abs(gap).max()) / scale
        if size < _CLOSED or (size < 1e-3 * _CLOSED**0.5 and size >= before):  # closed, or as far as rounding lets it
            return pose
        before = size
        columns = 3 if rods.translates else 6
        twist = np.zeros((6, 1))
        twist[:columns, 0] = np.linalg.lstsq(rods.gap_by_pose(home, pose)[0, :, :columns], -gap, rcond=1e-12)[0]
        large = max(float(np.abs(twist[:3]).max()) / scale, float(np.abs(twist[3:]).max()))
        twist *= min(1.0, _STEP / max(large, 1e-300))
        turned = rotate_by_vector(twist[3:], np.moveaxis(pose.rotation, 0, 2))
        pose = Poses(pose.position + twist[:3].T, np.moveaxis(turned, 2, 0))
    raise LoopClosureError(f"{rods.robot.source}: with this geometry the rods cannot be closed at home")
