"""Check that a robot's masses are those of its file, which a flexible model reads again."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot, load_robot_from_urdf


def require_file_masses(robot: Robot) -> None:
    """Refuse a robot whose parameters are not those of its file.

    Raises:
        InputError: They are not.
    """
    as_filed = load_robot_from_urdf(robot.urdf, robot.source, actuated=robot.actuated).parameters
    if as_filed.names != robot.parameters.names or np.any(as_filed.values != robot.parameters.values):
        raise InputError(
            "unsupported",
            f"{robot.source}: a flexible model takes its masses from the robot file; change them there",
        )
