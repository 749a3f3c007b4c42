"""What a drive may be asked for: range, speed, acceleration, force, and how far a correction may lead it away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot

PerJoint = float | np.ndarray | list[float] | tuple[float, ...]
"""A number for all joints, or one a joint (na,)."""


def broadcast_limit(robot: Robot, name: str, given: PerJoint | None, default: PerJoint) -> np.ndarray:
    """Return one limit a joint (na,), inf for none: what is given, else the default.

    Raises:
        InputError: A limit that is not above zero, or of the wrong length.
    """
    values = np.asarray(default if given is None else given, float)
    if values.shape not in ((), (1,), (robot.na,)):
        joints = ", ".join(robot.actuated)
        raise InputError(
            "wrong_shape",
            f"the {name} limit must be one number or {robot.na}, one a joint ({joints}), not {values.size}",
        )
    if not np.all(values > 0):
        raise InputError("invalid_value", f"the {name} limit must be above zero, not {np.min(values):g}")
    return np.broadcast_to(values, (robot.na,)).copy()


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
