"""References at the controller's sample period: files of positions, speeds and accelerations, one row per sample.

The files are CSV with the columns of all motion files of this package, `t`, `q_ref_J`, `v_ref_J`, `a_ref_J` [s, m or rad, per s,
per s^2], so `simulate` reads them too.

Sample period: a file with another period than the controller's is refused; resampling has to be requested, and is checked. The
extended IRC5 takes a reference every 4 ms (thesis 3.2). A file at another period would be played too fast or too slow, with
speeds that were never checked.

Limits of the drives: every limit is checked before a motion is written. Speeds and accelerations are checked both as stated in
the motion and as differences from sample to sample, which the controller sees.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import Trajectory, describe_exceeded_limit

PerJoint = float | np.ndarray | list[float] | tuple[float, ...]
"""A number for all joints, or one per joint (na,)."""


def broadcast_limit(robot: Robot, name: str, given: PerJoint | None, default: PerJoint) -> np.ndarray:
    """Return one limit per joint (na,), inf if unlimited: the given value, else the default.

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
"""Default of the largest correction of a turning drive [rad] and of a slide [m]."""


@dataclass(frozen=True, eq=False)
class CommandLimits:
    """Limits of references for a controller, one per joint (na,); inf if unlimited.

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
        """Return limits: the given ones, a number or one per joint; the rest from the robot file.

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
        InputError: A limit is exceeded; the message names every such limit with the joint and the time of the largest excess.
    """
    broken = list_exceeded_limits(model, motion, CommandLimits.of(model.robot) if limits is None else limits)
    if broken:
        raise InputError("unreachable", f"{motion.name} is not written: {'; '.join(broken)}")


def list_exceeded_limits(model: Model, motion: Trajectory, limits: CommandLimits) -> list[str]:
    """Return the limits that a motion exceeds, one clause per limit; empty if the robot can follow the motion.

    Args:
        model: Robot with its effects; it gives the forces, friction included.
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
    """Return the larger magnitude at each sample (N, na): the stated one or the (fewer) differences of neighbouring samples."""
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
    """Return a clause if a motion does not begin or end at rest, else an empty one."""
    top = float(np.abs(motion.v).max())
    for word, v in (("begins", motion.v[0]), ("ends", motion.v[-1])):
        k = int(np.argmax(np.abs(v)))
        if abs(v[k]) > _REST * top and top > 0:
            at = f"joint {motion.joints[k]} at {v[k]:.3g} {units[k]}/s"
            return f"it {word} with {at}; it must be at rest, or the robot is jerked"
    return ""


DEFAULT_PERIOD_S = 0.004
"""Sample period of the thesis' controller [s]."""

_JITTER = 1e-3  # share of the period; clocks written with four digits pass
_KEPT = 1e-3  # share of each joint's travel that resampling may change


def require_period(t: np.ndarray, period: float, name: str) -> None:
    """Refuse a clock (N,) [s] that is not the controller's.

    Raises:
        InputError: Its steps are uneven, or of another size; the message names the fault.
    """
    steps = np.diff(t)
    mean = float((t[-1] - t[0]) / len(steps))
    worst = int(np.argmax(np.abs(steps - mean)))
    if abs(steps[worst] - mean) > _JITTER * mean:
        raise InputError(
            "time_stamps",
            f"{name}: its samples are not even ({1e3 * steps[worst]:.4g} ms after sample {worst + 1}, {1e3 * mean:.4g} ms in the "
            "mean); resample it",
        )
    if abs(mean - period) > _JITTER * period:
        raise InputError(
            "time_stamps",
            f"{name}: it has a sample every {1e3 * mean:.6g} ms, the controller takes one every {1e3 * period:.6g} ms and would "
            f"play it {mean / period:.3g} times as fast; resample it, or give the controller's period",
        )


def resample_to_period(motion: Trajectory, period: float, *, resample: bool = False) -> Trajectory:
    """Return a motion on the controller's clock from zero.

    Args:
        motion: The motion.
        period: The controller's period [s].
        resample: Allow another clock: every n-th sample if the period is n times the motion's, else the quintic spline
            through the samples.

    Raises:
        InputError: The period differs and resampling was not requested, or resampling would lose part of the motion.
    """
    if not 0 < period < 1:
        raise InputError(
            "invalid_value", f"a controller's sample period is a positive number of seconds below 1, not {period:g}"
        )
    if not resample:
        require_period(motion.t, period, motion.name)
    n = count_samples_in_period(motion, period)
    found = motion.resampled(1 / period) if n in (0, 1) else _take_every(motion, n, period)
    if len(found.t) < 6:
        raise InputError(
            "too_little_data",
            f"{motion.name} lasts {motion.duration:g} s, {len(found.t)} samples of {1e3 * period:g} ms; too short",
        )
    left = motion.duration - found.duration
    if left > _JITTER * period:  # the last sample falls between two of the controller's: end where the motion ends
        found = _ended(motion, period)
    _require_kept(motion, found, period)
    return found


def count_samples_in_period(motion: Trajectory, period: float) -> int:
    """Return how many of the motion's samples make one period of the controller; 0 if the ratio is no whole number."""
    step = motion.duration / (motion.n_samples - 1)
    n = round(period / step)
    even = np.abs(np.diff(motion.t) - step).max() <= _JITTER * step
    return n if n >= 1 and even and abs(n * step - period) <= _JITTER * period else 0


def _take_every(motion: Trajectory, n: int, period: float) -> Trajectory:
    """Return every n-th sample as it is; the last one is held until the controller's next sample."""
    keep = np.minimum(np.arange(0, motion.n_samples + n - 1, n), motion.n_samples - 1)
    t = np.arange(len(keep)) * period
    return replace(motion, t=t, q=motion.q[keep], v=motion.v[keep], a=motion.a[keep])


def _ended(motion: Trajectory, period: float) -> Trajectory:
    """Return the motion with its last position held until the controller's next sample."""
    t, q = motion.t - motion.t[0], motion.q
    n = int(np.ceil(t[-1] / period - 1e-9))
    held = np.arange(1, 7)[:, None] * np.median(np.diff(t))
    longer = Trajectory.through(
        motion.joints, np.r_[t, t[-1] + held[:, 0]], np.r_[q, np.repeat(q[-1:], 6, axis=0)], motion.name
    )
    found = longer.resampled(1 / period)
    keep = slice(0, n + 1)
    return replace(found, t=found.t[keep], q=found.q[keep], v=found.v[keep], a=found.a[keep], notes=motion.notes)


def _require_kept(motion: Trajectory, found: Trajectory, period: float) -> None:
    """Refuse a clock too slow for the motion: its samples of position, speed and acceleration must lead there in between."""
    at = motion.t - motion.t[0]
    inside = at <= found.t[-1]
    off = np.abs(found.interpolate(at[inside])[0] - motion.q[inside]).max(axis=0)
    allowed = _KEPT * np.maximum(np.ptp(motion.q, axis=0), 1e-9)
    if np.any(off > allowed):
        k = int(np.argmax(np.round(off / allowed, 6)))
        raise InputError(
            "invalid_value",
            f"{motion.name}: samples every {1e3 * period:g} ms would miss joint {motion.joints[k]} by up to {off[k]:.3g} "
            f"({100 * off[k] / np.ptp(motion.q[:, k]):.2g} % of its stroke); the motion is too fast for this period",
        )


def build_reference(
    model: Model,
    motion: Trajectory,
    *,
    period: float = DEFAULT_PERIOD_S,
    resample: bool = False,
    limits: CommandLimits | None = None,
) -> Trajectory:
    """Return a motion that is ready for a controller: at its sample period and within the limits.

    Args:
        model: Robot and effects.
        motion: The motion.
        period: The controller's sample period [s].
        resample: Allow interpolation if the motion has another period.
        limits: Limits; default: those of the robot file.

    Raises:
        InputError: The sample period differs, or a limit is exceeded.
    """
    found = resample_to_period(motion, period, resample=resample)
    check_motion(model, found, limits)
    return found


def write_reference(
    path: str | Path,
    model: Model,
    motion: Trajectory,
    *,
    period: float = DEFAULT_PERIOD_S,
    resample: bool = False,
    limits: CommandLimits | None = None,
) -> None:
    """Write a reference file atomically; see `build_reference` for arguments and errors."""
    build_reference(model, motion, period=period, resample=resample, limits=limits).to_csv(path)


def read_reference(path: str | Path, joints: Sequence[str], *, period: float = DEFAULT_PERIOD_S) -> Trajectory:
    """Read a reference file.

    Args:
        path: The file.
        joints: Drives, in the order of the columns wanted.
        period: The controller's sample period [s].

    Raises:
        InputError: It cannot be read, or its sample period is another one.
    """
    found = Trajectory.from_csv(path, joints)
    require_period(found.t, period, found.name)
    return found


def compute_digest(motion: Trajectory) -> str:
    """Return a hash that identifies a motion: of joints, period and positions as a file holds them (12 digits)."""
    period = (motion.t[-1] - motion.t[0]) / (motion.n_samples - 1)
    words = [*motion.joints, f"{period:.9g}", *map("%.12g".__mod__, motion.q.ravel().tolist())]
    return hashlib.sha256(",".join(words).encode()).hexdigest()[:16]
