"""Logs with encoders at other joints of a loop than the drives: cylinders by pressure, pivots by angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from tau_dyn.log import Log, Recording
from tau_dyn.mechanism import compute_actuated_positions_from, list_loop_joints
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

AnyLog = TypeVar("AnyLog", bound=Log | Recording)


def complete_positions(robot: Robot, logs: Sequence[AnyLog]) -> list[AnyLog]:
    """Return the logs with the positions of actuated joints that follow from those of other joints of their loops.

    A log that has all of them, or too few of both, is returned unchanged. Recordings on disk are never completed.

    Raises:
        CannotAnswer: The logged joints do not determine the actuated ones.
        LoopClosureError: The loops do not close at a logged position.
    """
    others = list_loop_joints(robot)
    return [_complete(robot, others, log) if isinstance(log, Log) and others else log for log in logs]


def _complete(robot: Robot, others: Sequence[str], log: Log) -> Log:
    missing = [joint for joint in robot.actuated if not log.has("q", [joint])]
    known = [joint for joint in (*robot.actuated, *others) if log.has("q", [joint])]
    if not missing or len(known) < robot.na:
        return log
    read = log.joint("q", known)
    whole = np.isfinite(read).all(axis=1)
    found = np.full((log.n_samples, robot.na), np.nan)
    found[whole] = compute_actuated_positions_from(robot, known, read[whole])
    columns = {f"q_{joint}": found[:, robot.actuated.index(joint)] for joint in missing}
    said = f"{log.name}: positions of {', '.join(missing)} follow over the loops from those of {', '.join(known)}"
    return replace(
        log, channels={**log.channels, **columns}, warnings=(*log.warnings, CodedWarning("positions_from_loop", said))
    )
