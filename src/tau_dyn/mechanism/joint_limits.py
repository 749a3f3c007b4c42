"""Joint limits: whole turns taken off where that helps, and positions outside refused."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.kinematics_result import JOINT_LIMIT, InverseResult
from tau_dyn.robot import Robot

SLACK = 1e-9
"""Rounding at a joint limit [m or rad]."""


def unwind_turns(q: np.ndarray, turns: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return positions (N, na) with those outside their limits moved by a whole turn where that fits.

    Args:
        q: Positions (N, na) [m or rad], nan where there are none.
        turns: Which of the joints are turns that may be moved (na,).
        lower: Lower limits (na,).
        upper: Upper limits (na,).
    """
    q = q.copy()
    for k in np.flatnonzero(turns):
        for turn in (2 * np.pi, -2 * np.pi):
            outside = (q[:, k] < lower[k] - SLACK) | (q[:, k] > upper[k] + SLACK)
            moved = q[:, k] + turn
            fits = outside & (moved >= lower[k] - SLACK) & (moved <= upper[k] + SLACK)
            q[fits, k] = moved[fits]
    return q


def check_limits(robot: Robot) -> None:
    """Refuse limits that are the wrong way round.

    Raises:
        InputError: A lower limit is above its upper one.
    """
    for name, low, high in zip(robot.actuated, robot.lower, robot.upper, strict=True):
        if low > high:
            raise InputError(
                "robot_structure",
                f"{robot.source}: joint '{name}': its lower limit {low:g} is above its upper limit {high:g}",
            )


def refuse_beyond_limits(robot: Robot, found: InverseResult, limits: bool) -> InverseResult:
    """Return the positions with those outside joint limits refused; a turn may be a whole one away."""
    if not limits:
        return found
    turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
    q = unwind_turns(found.q, turns, robot.lower, robot.upper)
    with np.errstate(invalid="ignore"):
        beyond = np.any([q < robot.lower - SLACK, q > robot.upper + SLACK], axis=0)
    bad = beyond.any(axis=1)
    culprit = found.culprit.astype(object)
    for k in np.flatnonzero(bad):
        culprit[k] = " ".join(name for name, wrong in zip(robot.actuated, np.ravel(beyond[k]), strict=True) if wrong)
    code = np.where(bad, JOINT_LIMIT, found.code).astype(np.int8)
    allowed = np.where(bad[:, None], np.nan, q)
    lost = np.where(bad, np.nan, 1.0)
    return InverseResult(
        allowed,
        code,
        found.position_error * lost,
        found.orientation_error * lost,
        culprit.astype(str),
        q,
        found.rotation,
    )
