"""Logs as users hand them over: one or many, some twice, some trained on and held out at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from tau_dyn.coded_warning import UNCODED, CodedWarning, get_code
from tau_dyn.exceptions import InputError
from tau_dyn.identify.gate import SATURATION_RATIO
from tau_dyn.identify.preparation import MIN_SEGMENT_SAMPLES
from tau_dyn.log import Log, Recording, check_signals, find_moving_samples, list_unit_warnings
from tau_dyn.robot import Robot

Kind = TypeVar("Kind", bound=Log | Recording)

_CHANNEL_FAULTS = ("frozen", "clipping", "held")
"""What a fit does not notice by itself."""

_MAX_LISTED_WARNINGS = 4  # warnings about one log before they are counted instead of listed


def get_log_list(logs: Log | Recording | Iterable[Log | Recording]) -> list[Log | Recording]:
    """Return one log or many as a list; a path is refused."""
    if isinstance(logs, Log | Recording):
        return [logs]
    if isinstance(logs, str | Path):
        raise InputError("invalid_value", f"{str(logs)[:80]} is a path, not a Log; read it with read_log(path)")
    return list(logs)


def drop_duplicate_logs(logs: Sequence[Kind], warnings: list[str]) -> list[Kind]:
    """Return the logs without repetitions: the same samples twice would look like twice the evidence."""
    once: list[Kind] = []
    for log in logs:
        if any(has_common_samples(log, other) for other in once):
            warnings.append(f"{log.name} is given twice, or overlaps with a log given before; it counts once")
        else:
            once.append(log)
    return once


def log_warnings(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Return what is doubtful about the logs' pieces; of many alike from one file the first two and their number."""
    found: list[str] = []
    for name in dict.fromkeys(log.name for log in logs):
        pieces = [log for log in logs if log.name == name]
        of_logs = (w for log in pieces for w in (*log.warnings, *list_unit_warnings(log, robot)))
        longest = max(pieces, key=lambda log: log.n_samples)
        said = list(dict.fromkeys([*of_logs, *_channel_warnings(robot, longest)]))
        found += said if len(said) <= _MAX_LISTED_WARNINGS else _some(said, name)
    return found


def _some(said: list[str], name: str) -> list[str]:
    """Return the first two of many warnings, the first of each other code, and how many more there are."""
    codes = [get_code(sentence) for sentence in said]
    shown = [s for k, s in enumerate(said) if k < 2 or (codes[k] != UNCODED and codes[k] not in codes[:k])]
    return shown if len(shown) == len(said) else [*shown, f"{name}: {len(said) - len(shown)} more warnings like these"]


def _channel_warnings(robot: Robot, log: Log) -> list[str]:
    """Return what is wrong with the channels of a log, of those that the fit uses; forces at the drives' limits are gated out."""
    if log.n_samples < MIN_SEGMENT_SAMPLES:
        return []
    columns = {f"{signal}_{joint}" for signal in ("q", "tau") for joint in robot.actuated}
    limits = dict(zip((f"tau_{joint}" for joint in robot.actuated), robot.effort_limit, strict=True))
    used = {
        c: x
        for c, x in log.channels.items()
        if c in columns and np.abs(x).max() < SATURATION_RATIO * limits.get(c, np.inf)
    }
    channels = Log(log.t, used, log.name)
    moving = {joint: find_moving_samples(channels, joint) for joint in channels.joints("q")}
    found = check_signals(channels, moving)[0]
    doubtful = [f for f in found if f.topic in _CHANNEL_FAULTS and f.severity != "ok"]
    return [CodedWarning(f.code, f.sentence) if f.code else f.sentence for f in doubtful]


def drop_trained_logs(train: Sequence[Log | Recording], held: Sequence[Kind], warnings: list[str]) -> list[Kind]:
    """Drop held-out logs that are also trained on, and say so; their errors would not be held-out errors."""
    both = [log for log in held if any(has_common_samples(log, other) for other in train)]
    for log in both:
        warnings.append(
            f"{log.name} is both trained on and held out; its errors are not held-out errors and are left out"
        )
    return [log for log in held if log not in both]


def has_common_samples(one: Log | Recording, other: Log | Recording) -> bool:
    """Return whether two logs hold the same samples; parts of one file that do not overlap in time are different data."""
    if one is other:
        return True
    if not one.sha256 or one.sha256 != other.sha256:
        return False
    if isinstance(one, Recording) or isinstance(other, Recording):
        return True
    return bool(one.t[0] <= other.t[-1] and other.t[0] <= one.t[-1])


def require_forces(robot: Robot, logs: Sequence[Log | Recording]) -> None:
    """Refuse logs that hold positions and no force at all, and name what would do.

    Raises:
        InputError: A log has no force of any actuated joint.
    """
    for log in logs:
        if (
            isinstance(log, Log)
            and log.has("q", robot.actuated)
            and not any(log.has("tau", [j]) for j in robot.actuated)
        ):
            commands = " and commands" if log.has("cmd", robot.actuated[:1]) else ""
            raise InputError(
                "missing_column",
                f"{log.name} holds positions{commands} and no force; log each drive's force (tau_{robot.actuated[0]}), or its "
                "current, which a column map scales by torque constant and gear ratio; tool positions (x_tool, y_tool, z_tool) "
                "are diagnosed without forces",
            )
