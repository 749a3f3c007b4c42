"""What a drive may be asked for: range, speed, acceleration, force, and how far a correction may lead it away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.control.per_joint import PerJoint, broadcast_limit
from tau_dyn.robot import Robot

CORRECTION_TURN, CORRECTION_SLIDE = float(np.deg2rad(10.0)), 0.01
"""Largest correction of a turning drive [rad] and of a slide [m] where none is given."""


@dataclass(frozen=True, eq=False)
class CommandLimits:
    """Limits of what is sent to a controller, one a joint (na,); inf for none.

    Attributes:
        lower: Lowest position [m or rad].
        upper: Highest position.
        speed: Largest speed [m/s or rad/s].
        acceleration: Largest acceleration [m/s^2 or rad/s^2].
        force: Largest force [N or N m].
        correction: Largest correction [m or rad].
    """

    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    force: np.ndarray
    correction: np.ndarray

    @classmethod
    def of(
        cls,
        robot: Robot,
        *,
        speed: PerJoint | None = None,
        acceleration: PerJoint | None = None,
        force: PerJoint | None = None,
        correction: PerJoint | None = None,
    ) -> CommandLimits:
        """Return limits: those given, a number or one a joint, and the robot file's where none is.

        Raises:
            InputError: A limit that is not positive or of the wrong length.
        """
        usual = np.where([k == "revolute" for k in robot.joint_kinds], CORRECTION_TURN, CORRECTION_SLIDE)
        return cls(
            robot.lower,
            robot.upper,
            broadcast_limit(robot, "speed", speed, robot.velocity_limit),
            broadcast_limit(robot, "acceleration", acceleration, np.full(robot.na, np.inf)),
            broadcast_limit(robot, "force", force, robot.effort_limit),
            broadcast_limit(robot, "correction", correction, usual),
        )
