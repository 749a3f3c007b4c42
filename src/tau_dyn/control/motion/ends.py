"""Where a motion starts and ends: actuated positions of a tool position, checked against everything that hinders rest there."""

from __future__ import annotations

import numpy as np

from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import place_home_orientation
from tau_dyn.mechanism import inverse_kinematics
from tau_dyn.model import Model
from tau_dyn.robot import Robot

_SLACK = 1e-9  # m or rad; ends that equal a limit but for rounding are within it


def compute_end_positions(
    model: Model, place: np.ndarray, name: str, limits: MotionLimits, *, joints: bool, near: np.ndarray | None = None
) -> np.ndarray:
    """Return the actuated positions (na,) of one end, where the robot can stand still.

    Args:
        model: The robot and its effects.
        place: Tool position (3,) [m], in home's orientation, or actuated positions (na,) [m or rad].
        name: 'start' or 'end', for messages.
        limits: What the motion may use.
        joints: Whether `place` holds actuated positions.
        near: Positions (na,) near which to search, where several put the tool there.

    Raises:
        InputError: Out of reach, outside a joint's range, near a singularity, or too heavy to hold.
    """
    robot = model.robot
    given = np.asarray(place, float).ravel()
    wanted = robot.na if joints else 3
    if given.shape != (wanted,) or not np.isfinite(given).all():
        what = f"{robot.na} positions of {', '.join(robot.actuated)}" if joints else "a tool position x, y, z in m"
        raise InputError("wrong_shape", f"the {name} must be {what}: {wanted} finite numbers, not {place}")
    q = given if joints else _reached(robot, given, name, near)
    where = _place(robot, given) if joints else f"the {name} ({', '.join(f'{x:.6g}' for x in given)}) m"
    for k, joint in enumerate(robot.actuated):
        if not robot.lower[k] - _SLACK <= q[k] <= robot.upper[k] + _SLACK:
            allowed = f"{robot.lower[k]:g} to {robot.upper[k]:g} {robot.position_units[k]}"
            raise InputError("unreachable", f"{where} asks {q[k]:.4g} of joint {joint}, whose range is {allowed}")
    _check_closure(model, q, where, limits)
    _check_hold(model, q, where, limits)
    return q


def _reached(robot: Robot, position: np.ndarray, name: str, near: np.ndarray | None) -> np.ndarray:
    if robot.tool_frame is None:
        raise InputError(
            "unsupported",
            f"{robot.source}: there is no evident tool frame; name one with --tool FRAME, or give start and end as positions "
            "of the actuated joints",
        )
    found = inverse_kinematics(
        robot, place_home_orientation(robot, position[None]), start=None if near is None else near[None]
    )
    if not found.ok[0]:
        joint = f" at {found.culprit[0]}" if found.culprit[0] else ""
        at = ", ".join(f"{x:.6g}" for x in position)
        raise InputError(
            "unreachable", f"{robot.source}: the tool cannot stand at the {name} ({at}) m: {found.reason[0]}{joint}"
        )
    return found.q[0]


def _check_closure(model: Model, q: np.ndarray, where: str, limits: MotionLimits) -> None:
    condition = float(model.mechanism.condition(q[None])[0])  # raises LoopClosureError where the loops do not close
    if condition > limits.condition:
        raise InputError(
            "unreachable",
            f"{where} is near a singularity of the loops: conditioning {condition:.3g}, the limit is {limits.condition:.3g}",
        )


def _check_hold(model: Model, q: np.ndarray, where: str, limits: MotionLimits) -> None:
    """Refuse a place at which the drives' limits do not carry the weight."""
    rest = np.zeros((1, len(q)))
    weight = model.mechanism.inverse_dynamics(q[None], rest, rest)[0]
    k = int(np.argmax(np.abs(weight) / limits.force))
    if abs(weight[k]) >= limits.force[k]:
        unit = model.robot.force_units[k]
        raise InputError(
            "unreachable",
            f"joint {model.robot.actuated[k]} needs {abs(weight[k]):.4g} {unit} to hold still at {where}, and may use "
            f"{limits.force[k]:.4g} {unit}",
        )


def _place(robot: Robot, q: np.ndarray) -> str:
    return ", ".join(f"{j} = {x:.4g}" for j, x in zip(robot.actuated, q, strict=True))
