"""Logs of robots with loops in actuated coordinates: encoders at other joints, and more drives than freedoms.

Cylinders have pressures and pivots have encoders: positions follow over the loops. Forces of drives beyond the robot's freedoms
are projected on the actuated joints, with `v_redundant = B v`,

    tau_k + sum_i B_ik tau_i,

which holds no force inside the mechanism. Reference: Khalil & Dombre 2002, ch. 7 and 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.identify.motor_electrics import RECORDED
from tau_dyn.log import Log, Recording
from tau_dyn.mechanism import build_mechanism, compute_actuated_positions_from, list_loop_joints
from tau_dyn.message_codes import CodedWarning, get_code
from tau_dyn.robot import Robot

AnyLog = TypeVar("AnyLog", bound=Log | Recording)


def complete_positions(robot: Robot, logs: Sequence[AnyLog]) -> list[AnyLog]:
    """Return the logs in actuated coordinates: positions from other joints of their loops, forces of all drives projected.

    A log that has all positions, or too few of both, keeps them. Recordings on disk are never completed. Forces are projected
    for robots with more drives than freedoms only, and once.

    Raises:
        CannotAnswer: The logged joints do not determine the actuated ones.
        LoopClosureError: The loops do not close at a logged position.
        InputError: A log of a robot with more drives than freedoms lacks a drive's force, or is larger than memory.
    """
    others = list_loop_joints(robot)
    complete = [_complete(robot, others, log) if isinstance(log, Log) and others else log for log in logs]
    return [_project_forces(robot, log) for log in complete] if robot.redundant_joints else complete


def compute_redundant_rates(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the speed of redundant drives per actuated speed (N, r, na) at actuated positions (N, na); nan where these are."""
    rates = np.full((len(q), len(robot.redundant_joints), robot.na), np.nan)
    whole = np.isfinite(q).all(axis=1)
    rest = np.zeros_like(q[whole])
    rates[whole] = build_mechanism(robot).redundant_motion(q[whole], rest, rest)[:, :, : robot.na]
    return rates


def _project_forces(robot: Robot, log: AnyLog) -> AnyLog:
    """Return a log with generalised forces of the actuated joints in the place of their own drives' forces.

    Voltages and currents of actuated joints are left out: they belong to a single drive.
    """
    drives = (*robot.actuated, *robot.redundant_joints)
    if not isinstance(log, Log):
        raise InputError(
            "unsupported",
            f"{log.name} is larger than memory, and the robot has more drives than freedoms; give an excerpt",
        )
    how = f"forces of {', '.join(robot.redundant_joints)} are added to those of {', '.join(robot.actuated)} through the loops"
    marks = [warning for warning in log.warnings if get_code(warning) == "redundant_drives"]
    if marks and not any(mark.endswith(how) for mark in marks):
        raise InputError("unsupported", f"{marks[0]}; give the log as it was recorded, or name the same drives first")
    if marks or not log.has("q", robot.actuated) or not any(log.has("tau", [joint]) for joint in drives):
        return log
    missing = [f"tau_{joint}" for joint in drives if not log.has("tau", [joint])]
    if missing:
        raise InputError(
            "missing_column",
            f"{log.name} has no {', '.join(missing)}; {', '.join(drives)} are {len(drives)} drives on {robot.na} independent "
            "motion(s), so masses follow from the forces of all of them. Name the drives of this log with --actuated only if "
            "the others push nothing",
        )
    rates = compute_redundant_rates(robot, log.joint("q", robot.actuated))
    forces = log.joint("tau", robot.actuated) + np.einsum("nra,nr->na", rates, log.joint("tau", robot.redundant_joints))
    kept = {k: x for k, x in log.channels.items() if k not in {f"{s}_{j}" for s in RECORDED for j in drives}}
    changed = {f"tau_{joint}": forces[:, k] for k, joint in enumerate(robot.actuated)}
    return replace(
        log,
        channels={**kept, **changed},
        warnings=(*log.warnings, CodedWarning("redundant_drives", f"{log.name}: {how}")),
    )


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
