"""Check of a log of a robot with a floating base: its joints, as for other robots, and the motion of its base.

If a log has the velocity of the base in addition to its pose, the velocity is compared with the derivative of the pose: in axes
of the base, as required, and in axes of the world. Both look plausible; the turning of the robot separates them.

The logged pose and velocity of a floating base are converted to its six coordinates (`robot/floating_base.py`).

Columns of a log, after Pinocchio's free flyer:

    q_base_x, q_base_y, q_base_z                    position of the base link's origin in the world [m], z up
    q_base_qx, q_base_qy, q_base_qz, q_base_qw      orientation of the base in the world
    v_base_x, v_base_y, v_base_z                    velocity of that origin in axes of the base [m/s]
    v_base_wx, v_base_wy, v_base_wz                 angular velocity in axes of the base [rad/s]
    contact_FOOT; force_FOOT_x, _y, _z              whether a foot touches; the ground's force on it (`contact_forces.py`)

The orientation is needed, since it gives the direction of gravity. The position may be missing if the velocity is logged: it
is then the velocity's integral in world axes, whose drift has no effect on the equations of motion. Velocities and
accelerations are computed from these coordinates with the same filters as for the joints. A logged velocity has to agree with
the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.legged.contact_forces import add_contact_forces, is_contact_force_measured, name_contact_forces
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    CheckFinding,
    ColumnProposal,
    Log,
    LogCheck,
    Recording,
    check_log,
    differentiate,
    lowpass,
    propose_columns,
    read_any,
    resample_segments,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

AnyLog = TypeVar("AnyLog", bound=Log | Recording)
POSITION = ("q_base_x", "q_base_y", "q_base_z")
QUATERNION = ("q_base_qx", "q_base_qy", "q_base_qz", "q_base_qw")
LINEAR = ("v_base_x", "v_base_y", "v_base_z")
ANGULAR = ("v_base_wx", "v_base_wy", "v_base_wz")
MAX_PITCH = np.radians(80.0)
"""Largest pitch [rad]: beyond it yaw and roll are ill-defined; accelerations in them grow by `1 / cos^2`."""
MAX_NORM_ERROR = 0.05
"""Largest difference of a quaternion's length from one; with more, the columns are no quaternion."""


def complete_base(robot: Robot, logs: Sequence[AnyLog]) -> list[AnyLog]:
    """Return logs with the positions of a floating base's coordinates, and their forces: zero, or those of measured feet.

    Logs of a robot with a fixed base are returned unchanged.

    Raises:
        InputError: The orientation is missing or no rotation, position and velocity are both missing, the base pitches
            beyond 80 degrees, forces of feet cannot be used (`add_contact_forces`), or a recording is larger than memory.
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
    completed = replace(log, channels=channels | {f"tau_{name}": np.zeros(log.n_samples) for name in names})
    return add_contact_forces(robot, completed)


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


_COMPARED_HZ = 5.0
"""Low-pass of both velocities before they are compared [Hz]: above it a pose's noise is most of its derivative."""
_CLEARER = 3.0
"""Smallest ratio of the errors in both frames at which the frame of a velocity is certain."""


@dataclass(frozen=True)
class DrivenJoints:
    """The joints with a motor of a robot, as `check_log` and `propose_columns` take them; see `log.JointLimits`."""

    actuated: tuple[str, ...]
    joint_kinds: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(cls, robot: Robot) -> Self:
        """Take them from a robot."""
        first = len(robot.base_coordinates)
        return cls(robot.driven, robot.joint_kinds[first:], robot.lower[first:], robot.upper[first:])


def check_robot_log(log: Log, robot: Robot | None) -> LogCheck:
    """Return the check of a log against its robot; for a floating base it includes the faults of the base's motion."""
    if robot is None or not robot.base_coordinates:
        return check_log(log, robot)
    joints = {name: x for name, x in log.channels.items() if not name.startswith(("q_base_", "v_base_"))}
    checked = check_log(replace(log, channels=joints), DrivenJoints.of(robot))
    # positions of joints jump when feet touch down, without lost samples
    findings = [finding for finding in checked.findings if finding.code != "lost_samples"]
    try:
        complete_base(robot, [log])
    except InputError as fault:
        findings.append(CheckFinding("fault", "base", str(fault), "Log it, or name it in a map (--columns MAP.yaml)."))
    else:
        findings.append(CheckFinding("ok", "base", f"{log.name} has orientation and position or velocity of the base."))
        findings += [
            CheckFinding("fault" if w.code == "base_velocity_frame" else "warning", "base", str(w), code=w.code)
            for w in list_base_warnings(robot, [log])
        ]
    return replace(checked, findings=tuple(findings))


def propose_robot_columns(path: str | Path, robot: Robot) -> ColumnProposal:
    """Return the column map proposed for a log of a robot; for a floating base it includes the columns of base and feet.

    The columns of base and feet are accepted only under their own names; missing ones are listed, with lines to complete.

    Raises:
        InputError: The log cannot be read.
        CannotAnswer: No column but the clock holds numbers.
    """
    proposal = propose_columns(path, DrivenJoints.of(robot))
    if not robot.base_coordinates:
        return proposal
    there = read_any(Path(path)).cells
    feet = tuple(f"contact_{contact.frame}" for contact in robot.contacts)
    forces = tuple(name for contact in robot.contacts for name in name_contact_forces(contact))
    known = {name: name for name in (*POSITION, *QUATERNION, *LINEAR, *ANGULAR, *feet, *forces) if name in there}
    place = POSITION if not all(name in known for name in LINEAR) else ()
    measured = [f"contact_{c.frame}" for c in robot.contacts if set(name_contact_forces(c)) <= set(known)]
    missing = [name for name in (*place, *QUATERNION, *feet) if name not in {*known, *measured}]
    if not missing:
        return replace(proposal, entries={**proposal.entries, **known})
    sentence = (
        f"No column is called {', '.join(missing)}: orientation and position of the base, and feet that touch the ground. "
        "Complete their lines in the map."
    )
    return replace(
        proposal,
        entries={**proposal.entries, **known},
        warnings=(*proposal.warnings, CodedWarning("column_missing", sentence)),
        template=(*proposal.template, *(f"# {name}: COLUMN" for name in missing)),
    )


def list_base_warnings(robot: Robot, logs: Sequence[Log | Recording]) -> list[CodedWarning]:
    """Return warnings about feet and base velocity of logs with an orientation of the base; empty for a fixed base."""
    here = [log for log in logs if isinstance(log, Log) and robot.base_coordinates]
    return [warning for log in here for warning in _list_warnings(robot, log)]


def _list_warnings(robot: Robot, log: Log) -> list[CodedWarning]:
    unknown = [contact for contact in robot.contacts if not is_contact_force_measured(contact, log)]
    missing = [contact.frame for contact in unknown if f"contact_{contact.frame}" not in log.channels]
    found = []
    if missing:
        listed = ", ".join(f"contact_{frame}" for frame in missing)
        found.append(
            CodedWarning(
                "contact_unknown",
                f"{log.name} has no {listed}: these feet count as touching the ground all the time, and the equations of "
                "their legs in the air are not used; log 0 or 1, or the force in N",
            )
        )
    pieces = resample_segments(log)
    longest = max(pieces, key=lambda piece: piece.n_samples, default=log)
    if longest.n_samples >= MIN_SEGMENT_SAMPLES:
        found += _compare_velocities(longest)
    return found


def _compare_velocities(log: Log) -> list[CodedWarning]:
    """Return a warning about each velocity of the base that agrees with the pose in axes of the world instead."""
    rotation, dt = read_rotation(log), log.dt
    cutoff = min(_COMPARED_HZ, 0.2 * log.rate_hz)
    found = []
    if all(name in log.channels for name in POSITION):
        world = differentiate(lowpass(_stack(log, POSITION), cutoff, log.rate_hz), dt)
        found += _compare(log, LINEAR, world, rotation, cutoff)
    turn = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / dt
    spin = lowpass(np.concatenate([turn, turn[-1:]]), cutoff, log.rate_hz)
    return found + _compare(log, ANGULAR, rotation.apply(spin), rotation, cutoff)


def _compare(
    log: Log, names: tuple[str, ...], world: np.ndarray, rotation: Rotation, cutoff: float
) -> list[CodedWarning]:
    if not all(name in log.channels for name in names):
        return []
    logged = lowpass(_stack(log, names), cutoff, log.rate_hz)
    ends = slice(len(logged) // 20, len(logged) - len(logged) // 20)
    in_base, in_world = (float(np.sqrt(np.mean((logged - x)[ends] ** 2))) for x in (rotation.inv().apply(world), world))
    if in_base <= _CLEARER * in_world:
        return []
    unit = "m/s" if names == LINEAR else "rad/s"
    return [
        CodedWarning(
            "base_velocity_frame",
            f"{log.name}: {', '.join(names)} are in axes of the world: they differ from the pose's velocity by {in_world:.2g} "
            f"{unit} there and by {in_base:.2g} {unit} in axes of the base, where they belong; turn them by the inverse of "
            "the base's orientation",
        )
    ]


def _stack(log: Log, names: tuple[str, ...]) -> np.ndarray:
    return np.column_stack([log.channels[name] for name in names])
