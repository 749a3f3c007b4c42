"""From the logged pose and velocity of a floating base to its six coordinates (`robot/floating_base.py`).

Columns of a log, after Pinocchio's free flyer:

    q_base_x, q_base_y, q_base_z                    position of the base link's origin in the world [m], z up
    q_base_qx, q_base_qy, q_base_qz, q_base_qw      orientation of the base in the world
    v_base_x, v_base_y, v_base_z                    velocity of that origin in axes of the base [m/s]
    v_base_wx, v_base_wy, v_base_wz                 angular velocity in axes of the base [rad/s]

The orientation is needed, since it says where gravity points. The position may be missing where the velocity is there: it is
then the velocity's integral in world axes, whose drift no equation of motion feels. Velocities and accelerations come from these
coordinates through the same filters as those of the joints. A velocity that is logged beside the pose has to agree with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, Recording
from tau_dyn.robot import Robot

AnyLog = TypeVar("AnyLog", bound=Log | Recording)
POSITION = ("q_base_x", "q_base_y", "q_base_z")
QUATERNION = ("q_base_qx", "q_base_qy", "q_base_qz", "q_base_qw")
LINEAR = ("v_base_x", "v_base_y", "v_base_z")
ANGULAR = ("v_base_wx", "v_base_wy", "v_base_wz")
MAX_PITCH = np.radians(80.0)
"""Pitch [rad] beyond which yaw and roll are no coordinates any more; accelerations in them grow by `1 / cos^2`."""
MAX_NORM_ERROR = 0.05
"""Difference of a quaternion's length from one; more, and the columns are no quaternion's."""


def complete_base(robot: Robot, logs: Sequence[AnyLog]) -> list[AnyLog]:
    """Return logs with the positions of a floating base's coordinates, and their forces, which are zero.

    Logs of a robot with a fixed base come back as they are.

    Raises:
        InputError: The orientation is missing or no rotation, neither position nor velocity is there, the base stands upright
            on its nose, or a recording is larger than memory.
    """
    return [_complete(robot, log) for log in logs] if robot.base_coordinates else list(logs)


def _complete(robot: Robot, log: AnyLog) -> AnyLog:
    if not isinstance(log, Log):
        raise InputError(
            "unsupported", f"{log.name}: a recording larger than memory has no floating base yet; give an excerpt"
        )
    rotation = read_rotation(log)
    R = rotation.as_matrix()
    yaw, pitch = np.arctan2(R[:, 1, 0], R[:, 0, 0]), np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    steepest = int(np.argmax(np.abs(pitch)))
    if abs(pitch[steepest]) > MAX_PITCH:
        raise InputError(
            "unsupported",
            f"{log.name}: the base pitches by {np.degrees(pitch[steepest]):.0f} degrees at t = {log.t[steepest]:.4g} s; "
            f"up to {np.degrees(MAX_PITCH):.0f} degrees can be used, so leave this part out",
        )
    values = (*_read_position(log, rotation).T, np.unwrap(yaw), pitch, np.unwrap(roll))
    names = robot.base_coordinates
    raw = {*QUATERNION, *LINEAR, *ANGULAR}
    channels = {name: x for name, x in log.channels.items() if name not in raw}
    channels |= {f"q_{name}": x for name, x in zip(names, values, strict=True)}
    return replace(log, channels=channels | {f"tau_{name}": np.zeros(log.n_samples) for name in names})


def read_rotation(log: Log) -> Rotation:
    """Return the base's orientation in the world, N of them.

    Raises:
        InputError: A column is missing, or the four are no unit quaternion.
    """
    missing = [name for name in QUATERNION if name not in log.channels]
    if missing:
        raise InputError(
            "missing_column",
            f"{log.name} has no column {missing[0]}; a floating base needs its orientation {', '.join(QUATERNION)}, and "
            f"its position {', '.join(POSITION)} or its velocity {', '.join(LINEAR)} in axes of the base",
        )
    quaternion = np.column_stack([log.channels[name] for name in QUATERNION])
    size = np.linalg.norm(quaternion, axis=1)
    off = int(np.argmax(np.abs(size - 1)))
    if not abs(size[off] - 1) < MAX_NORM_ERROR:
        raise InputError(
            "bad_sample",
            f"{log.name}: {', '.join(QUATERNION)} have length {size[off]:.3g} at t = {log.t[off]:.4g} s; "
            "the length of a quaternion is 1",
        )
    return Rotation.from_quat(quaternion)


def _read_position(log: Log, rotation: Rotation) -> np.ndarray:
    """Return the base's position (N, 3) [m]."""
    if all(name in log.channels for name in POSITION):
        return np.column_stack([log.channels[name] for name in POSITION])
    missing = [name for name in (*POSITION, *LINEAR) if name not in log.channels]
    if any(name in missing for name in LINEAR):
        raise InputError(
            "missing_column",
            f"{log.name} has no column {missing[0]}; a floating base needs its position {', '.join(POSITION)}, or its "
            f"velocity {', '.join(LINEAR)} in axes of the base",
        )
    velocity = rotation.apply(np.column_stack([log.channels[name] for name in LINEAR]))
    return cumulative_trapezoid(velocity, log.t, axis=0, initial=0.0)
