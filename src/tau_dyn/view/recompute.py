"""What a result's file leaves out, worked out again from the robot: coarsely, and only when asked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot

_ACROSS = 16
"""Points along the longest side of a coarse workspace."""


def recompute_workspace(robot: Robot, resolution: float, box: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return points (n, 3) [m] inside the workspace, and their condition number by name.

    Args:
        robot: The robot.
        resolution: Of the result [m]; no finer one is used.
        box: Corners (2, 3) [m] of the workspace.
    """
    from tau_dyn.kinematics.workspace import build_points_table, study_workspace

    step = max(resolution, float(np.ptp(box, axis=0).max()) / _ACROSS)
    table = build_points_table(study_workspace(robot, resolution=step, maps=["condition"]))
    inside = table[table["inside"] == 1]
    points = inside[["x_tool", "y_tool", "z_tool"]].to_numpy(float)
    return points, {"condition number": inside["condition"].to_numpy(float)}


def recompute_calibration(content: dict[str, Any], robot: Robot, path: Path) -> dict[str, Any]:
    """Return the errors of the robot file's dimensions at the measured poses, its base where they are smallest.

    The poses are read from where the result says they lie, and must be the same file still.

    Raises:
        InputError: They are not.
    """
    from tau_dyn.calibrate import align, read_poses
    from tau_dyn.mechanism import forward_kinematics
    from tau_dyn.robot import read_annotations

    files = [i for i in content.get("inputs", []) if str(i["path"]).endswith(".csv")]
    if not files:
        raise InputError("mismatch", f"{path}: it names no file of measured poses")
    mimics = read_annotations(robot.urdf, robot.source).mimics
    poses = read_poses(Path(files[0]["path"]), robot.actuated, mimics=mimics)
    if poses.sha256 != files[0]["sha256"]:
        raise InputError(
            "mismatch", f"{files[0]['path']}: changed since {path.name} was written; its errors would not be those"
        )
    found = forward_kinematics(robot, poses.q)
    at, seen = found.poses.position[found.ok], poses.position[found.ok]
    device = align(at, seen)  # the base frame where the measuring device's points fit best
    points = seen @ np.asarray(device.rotation).T + device.translation
    return {"points": points, "models": {"robot file": points - at}}
