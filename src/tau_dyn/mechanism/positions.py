"""Actuated positions as users give them."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot


def require_positions(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return actuated positions as an array (N, na); one sample may come without its first axis.

    Raises:
        InputError: The array has another shape.
    """
    q = np.asarray(q, float)
    q = q[None] if q.ndim == 1 else q
    if q.ndim != 2 or q.shape[1] != robot.na:
        raise InputError(
            "wrong_shape",
            f"{robot.source} has {robot.na} actuated joints ({', '.join(robot.actuated)}); "
            f"positions must be (N, {robot.na}), not {q.shape}",
        )
    return q
