"""Integrity tests of a log, shared by `check`, `identify` and `diagnose`.

The data alone show lost, repeated, zeroed, held and frozen samples (`log/data_integrity.py`). With the robot file, wiring
(`wiring.py`) and the time of the forces (`force_timing.py`) are judged on the middle minute of each mended log, joint by joint.
If losses cannot be mended, only they are reported, because they look like wrong scales and delays.

A fault blocks only the results that it can bias. A fault that was mended, or whose samples were left out, is a note.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from hashlib import blake2b

import numpy as np

from tau_dyn.identify.integrity.excerpt import Records, make_excerpt
from tau_dyn.identify.integrity.force_timing import check_timing
from tau_dyn.identify.integrity.wiring import check_wiring
from tau_dyn.identify.preparation import find_excluded_samples, widen
from tau_dyn.log import Log, list_data_warnings, mend_log, resample_segments
from tau_dyn.message_codes import CodedWarning, RepairedWarning, get_code
from tau_dyn.robot import Robot

SPOILING = frozenset(
    {
        "sign_reversed",
        "joints_exchanged",
        "scale_wrong",
        "gravity_direction",
        "gravity_subtracted",
        "model_subtracted",
        "mean_removed",
        "lost_samples",
        "repeated_samples",
        "force_at_limit",
        "faulty_channel",
        "updated_less_often",
    }
)
"""Codes of faults that imitate physical effects if they remain in the data: with them, no cause may be confirmed."""

MAX_LOGS = 5
"""Number of logs that are compared with the robot file; the columns of a campaign are wired in the same way."""


LIMIT_REACH_S = 0.1
"""Time about a force at its drive's limit within which filters mix it with its neighbours [s]."""

MAX_NEAR_LIMIT = 0.5
"""Share of such samples above which a log gives a warning: the noise then selects the remaining samples, which is a bias."""

MAX_BEYOND_LIMIT = 1.2
"""Force over its limit above which the drive is not at its limit: sensors are off and overshoot by less."""

MAX_FOUND = 100
"""Number of logs whose faults are cached; the oldest is dropped first."""
_FOUND: dict[bytes, tuple[CodedWarning, ...]] = {}
"""Faults that logs have against robots, by a hash of all that they depend on."""


def check_integrity(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...] = ()) -> list[CodedWarning]:
    """Return coded warnings about logs, each with evidence and remedy; empty for sound logs.

    Args:
        robot: The robot file that the logs should belong to.
        logs: Logs as read.
        exclude: Columns whose nonzero samples are left out.
    """
    told = [_list_data_warnings(robot, log) for log in logs]
    return [*(warning for of_log in told for warning in of_log), *_against_robot(robot, logs, told, exclude)]


def check_against_robot(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...] = ()) -> list[CodedWarning]:
    """Return faults of wiring and timing of logs as read against a robot file with masses; see `check_integrity`."""
    return _against_robot(robot, logs, [_list_data_warnings(robot, log) for log in logs], exclude)


def _list_data_warnings(robot: Robot, log: Log) -> list[CodedWarning]:
    """Return faults that a log shows by itself, without lost samples for a walker, whose joints jump when feet touch down."""
    found = list_data_warnings(log, robot.driven)
    return [w for w in found if w.code != "lost_samples"] if robot.base_coordinates else found


def _against_robot(
    robot: Robot, logs: Sequence[Log], told: Sequence[Sequence[str]], exclude: tuple[str, ...]
) -> list[CodedWarning]:
    """Return forces at their limits and faults of wiring and timing of logs, given the warnings from each log's data alone."""
    at_limits = [warning for log in logs for warning in _list_at_limits(robot, log)]
    if robot.base_coordinates or not sum(float(link.nominal[0]) for link in robot.links) > 0:
        return at_limits  # wiring and timing need forces without contact forces of the ground
    found: list[CodedWarning] = at_limits
    longest = sorted(zip(logs, told, strict=True), key=lambda pair: -pair[0].duration)[:MAX_LOGS]
    for log, warnings in longest:
        if not is_diagnosis_invalid(warnings):
            found += _against_columns(robot, mend_log(log, robot.actuated), log.name, exclude)
    return list(dict.fromkeys(found))


def _list_at_limits(robot: Robot, log: Log) -> list[CodedWarning]:
    """Return the joints whose forces are at their drives' limits, or beyond them, so often that little is left between."""
    if not log.has("tau", robot.actuated):
        return []
    shut = find_excluded_samples(log, robot.actuated, robot.effort_limit, ())
    near = widen(shut, int(np.ceil(LIMIT_REACH_S * log.rate_hz))).mean(axis=0)
    largest = np.abs(log.joint("tau", robot.actuated)).max(axis=0) / robot.effort_limit
    told = zip(robot.actuated, robot.effort_limit, robot.force_units, shut.mean(axis=0), near, largest, strict=True)
    return [
        CodedWarning("force_at_limit", f"{log.name}: {_describe_limit(joint, f'{limit:g} {unit}', share, part, ratio)}")
        for joint, limit, unit, share, part, ratio in told
        if part > MAX_NEAR_LIMIT
    ]


def _describe_limit(joint: str, limit: str, share: float, near: float, ratio: float) -> str:
    """Return how often a joint's force is at its limit, or beyond it, where the limit or the force's unit is wrong."""
    left_out = (
        f"in {100 * share:.0f} % of the samples, and {100 * near:.0f} % are within {LIMIT_REACH_S:g} s of one; these are "
        "left out"
    )
    if ratio > MAX_BEYOND_LIMIT:
        return (
            f"the force of {joint} is beyond its limit of {limit}, up to {ratio:.3g} times, {left_out}. No drive exceeds its "
            f"limit: check the unit and scale of tau_{joint}, and the limit in the robot file"
        )
    return (
        f"the force of {joint} is at its limit of {limit} {left_out}. Record a gentler motion, or mend the limit in the robot "
        "file"
    )


def _against_columns(robot: Robot, log: Log, name: str, exclude: tuple[str, ...]) -> tuple[CodedWarning, ...]:
    """Return the faults of one sound log; they are cached, as `diagnose` needs those of `identify` again."""
    content = blake2b(
        repr(
            (name, exclude, robot.parameters.names, [(link.own, link.nominal.tolist()) for link in robot.links])
        ).encode()
    )
    placed = {f.name: getattr(robot, f.name) for f in fields(robot) if f.name not in ("model", "links", "parameters")}
    content.update(repr(placed).encode() + robot.model.saveToString().encode() + robot.parameters.values.tobytes())
    for channel, values in {"": log.t, **log.channels}.items():
        content.update(channel.encode() + values.tobytes())
    if (known := _FOUND.get(content.digest())) is None:
        excerpt = make_excerpt(robot, resample_segments(log), exclude)
        found = excerpt and (
            check_wiring(robot, excerpt, name, Records.of(robot, excerpt, log)) or check_timing(robot, excerpt, name)
        )
        known = _FOUND[content.digest()] = tuple(found or ())
        if len(_FOUND) > MAX_FOUND:
            _FOUND.pop(next(iter(_FOUND)), None)
    return known


def is_diagnosis_invalid(warnings: Iterable[str]) -> bool:
    """Return whether a fault that remains in the data would imitate physical effects, so that no cause may be confirmed."""
    return any(get_code(warning) in SPOILING and not isinstance(warning, RepairedWarning) for warning in warnings)
