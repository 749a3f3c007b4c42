"""What a planned motion may use: forces, speeds, accelerations, jerks, strokes, and how well the loops must close."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.control.per_joint import PerJoint, broadcast_limit
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import compute_condition_bound

_NONE = 1e8  # acceleration [m/s^2 or rad/s^2] above which a drive is as good as unlimited


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of a motion, one a joint (na,) unless said otherwise; inf for none.

    Attributes:
        force: Largest force, in either direction [N or N m].
        speed: Largest speed [m/s or rad/s].
        acceleration: Largest acceleration [m/s^2 or rad/s^2].
        jerk: Largest jerk [m/s^3 or rad/s^3].
        lower: Lowest position [m or rad].
        upper: Highest position.
        condition: Largest conditioning of the loops (a number).
    """

    force: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    condition: float

    @classmethod
    def of(
        cls,
        model: Model | Robot,
        *,
        force: PerJoint | None = None,
        speed: PerJoint | None = None,
        acceleration: PerJoint | None = None,
        jerk: PerJoint | None = None,
        margin: float = 0.0,
        condition: float | None = None,
    ) -> MotionLimits:
        """Return limits: those given, and the robot file's where none is.

        Args:
            model: Robot or model.
            force: Instead of the drives' limits of the robot file.
            speed: Instead of its speed limits.
            acceleration: None for no limit.
            jerk: None for no limit. (The acceleration is continuous and zero at both ends in any case.)
            margin: Share of the forces that stays unused, for the feedback that will run the motion; 0 to below 1.
            condition: Largest conditioning of the loops; by default five times home's, at least 20.

        Raises:
            InputError: A limit that is not positive, of the wrong length, or that leaves a joint without any limit.
        """
        model = model if isinstance(model, Model) else Model.of(model)
        robot = model.robot
        if not 0 <= margin < 1:
            raise InputError(
                "invalid_value",
                f"margin is the share of the forces kept for feedback, from 0 to below 1, not {margin:g}",
            )
        found = cls(
            (1 - margin) * _limit(robot, "force", force, robot.effort_limit),
            _limit(robot, "speed", speed, robot.velocity_limit),
            _limit(robot, "acceleration", acceleration, np.inf),
            _limit(robot, "jerk", jerk, np.inf),
            robot.lower,
            robot.upper,
            compute_condition_bound(model) if condition is None else float(condition),
        )
        for joint, force_, most in zip(robot.actuated, found.force, found.acceleration, strict=True):
            if not np.isfinite(min(force_, most)):
                raise InputError(
                    "unsupported",
                    f"{robot.source}: joint {joint} has no force limit, so no shortest time; give a limit of its force or "
                    "acceleration",
                )
        if not found.condition >= 1:
            raise InputError(
                "invalid_value", f"the largest conditioning of the loops must be at least 1, not {found.condition:g}"
            )
        return found

    def inside(self, share: float) -> MotionLimits:
        """Return limits of force, speed, acceleration and jerk smaller by a share."""
        less = {name: (1 - share) * getattr(self, name) for name in ("force", "speed", "acceleration", "jerk")}
        return replace(self, **less)


def _limit(robot: Robot, name: str, given: PerJoint | None, default: PerJoint) -> np.ndarray:
    """Return one limit a joint (na,), those that no drive reaches as none."""
    values = broadcast_limit(robot, name, given, default)
    return np.where(values < _NONE, values, np.inf)
