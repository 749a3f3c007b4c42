"""What is given as one number for all joints, or as one a joint."""

from __future__ import annotations

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
