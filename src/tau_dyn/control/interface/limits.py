"""What a drive may be asked for, and whether a controller may be given a motion: every limit is looked at before it is written.

Speeds and accelerations are judged both as the motion states them and as the controller will see them, from sample to sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import Trajectory, describe_exceeded_limit

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


_SLACK = 1e-9  # relative; values that equal a limit but for rounding are within it
_REST = 0.02  # share of the largest speed that a motion may begin or end with


def check_motion(model: Model, motion: Trajectory, limits: CommandLimits | None = None) -> None:
    """Refuse a motion that leaves a limit; see `list_exceeded_limits`.

    Raises:
        InputError: One sentence that names every broken limit with the joint and the time where it is broken most.
    """
    broken = list_exceeded_limits(model, motion, CommandLimits.of(model.robot) if limits is None else limits)
    if broken:
        raise InputError("unreachable", f"{motion.name} is not written: {'; '.join(broken)}")


def list_exceeded_limits(model: Model, motion: Trajectory, limits: CommandLimits) -> list[str]:
    """Return what hinders the robot from following a motion, a clause a limit; empty where nothing does.

    Args:
        model: Robot with its effects; forces are its, friction included.
        motion: The motion, on the controller's clock.
        limits: The limits.
    """
    robot, dt = model.robot, float(motion.t[1] - motion.t[0])
    if motion.joints != robot.actuated:
        return [f"it moves {', '.join(motion.joints)}, the robot has {', '.join(robot.actuated)}"]
    units, names = np.array(robot.position_units), motion.joints
    clauses = [
        _over(names, motion.t, np.maximum(limits.lower - motion.q, motion.q - limits.upper), motion.q, "reaches", units,
              [f"may go from {a:g} to {b:g}" for a, b in zip(limits.lower, limits.upper, strict=True)]),
        _beyond(names, motion.t, _larger(motion.v, np.diff(motion.q, axis=0) / dt), limits.speed, "moves at", units, "/s"),
        _beyond(names, motion.t, _larger(motion.a, np.diff(motion.q, n=2, axis=0) / dt**2), limits.acceleration,
                "accelerates by", units, "/s^2"),
        _unrest(motion, units),
    ]  # fmt: skip
    found = [c for c in clauses if c]
    loops = describe_exceeded_limit(model, motion, forces=False) if not found else None
    if found or loops:
        return [*found, *([loops] if loops else [])]
    tau = model.steady().torque(motion.q, motion.v, motion.a)
    forces = _beyond(names, motion.t, tau, limits.force, "needs", np.array(robot.force_units), "")
    return [forces] if forces else []


def _larger(stated: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return what is larger at each sample (N, na), the stated or the one between neighbouring samples (fewer)."""
    out = np.abs(stated)
    for shift in range(len(stated) - len(seen) + 1):
        part = slice(shift, shift + len(seen))
        out[part] = np.maximum(out[part], np.abs(seen))
    return out


def _beyond(
    names: tuple[str, ...], t: np.ndarray, x: np.ndarray, limit: np.ndarray, verb: str, units: np.ndarray, per: str
) -> str:
    said = [f"may no more than {a:.4g}" for a in limit]
    return _over(names, t, np.abs(x) - limit * (1 + _SLACK), x, verb, np.char.add(units, per), said)


def _over(
    names: tuple[str, ...],
    t: np.ndarray,
    excess: np.ndarray,
    x: np.ndarray,
    verb: str,
    units: np.ndarray,
    allowed: list[str],
) -> str:
    if not np.max(excess) > _SLACK:
        return ""
    k, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
    return f"joint {names[j]} {verb} {x[k, j]:.4g} {units[j]} at t = {t[k]:.4g} s and {allowed[j]} {units[j]}"


def _unrest(motion: Trajectory, units: np.ndarray) -> str:
    """Say that a motion does not begin or end at rest."""
    top = float(np.abs(motion.v).max())
    for word, v in (("begins", motion.v[0]), ("ends", motion.v[-1])):
        k = int(np.argmax(np.abs(v)))
        if abs(v[k]) > _REST * top and top > 0:
            at = f"joint {motion.joints[k]} at {v[k]:.3g} {units[k]}/s"
            return f"it {word} with {at}; it must be at rest, or the robot is jerked"
    return ""
