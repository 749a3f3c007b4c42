"""Is a log fit for use? Its clock, its channels, its motion and its units, judged before anything is estimated.

`check_log` asks the three siblings `check_clock.py`, `check_signals.py` and `check_motion.py`, and the robot if there
is one, and `data_integrity.py` for losses on the way to the file. Wiring and the time of the forces take a model:
`identify/log_integrity.py`.
"""

from typing import Any

import numpy as np

from tau_dyn.coded_warning import UNCODED, get_code
from tau_dyn.log.check_clock import check_clock
from tau_dyn.log.check_motion import check_motion, find_moving_samples
from tau_dyn.log.check_result import CheckFinding, LogCheck, Severity, build_fault
from tau_dyn.log.column_names import format_names
from tau_dyn.log.data_integrity import list_data_warnings
from tau_dyn.log.jumps import check_jumps
from tau_dyn.log.log import Log
from tau_dyn.log.resample import resample_segments, split_at_gaps
from tau_dyn.log.signal_checks import check_signals
from tau_dyn.log.units import JointLimits, list_unit_warnings


def check_log(log: Log, robot: JointLimits | None = None) -> LogCheck:
    """Judge whether a log is fit for identification.

    Args:
        log: A log as read. Where it has gaps, channels and motion are judged on its longest part.
        robot: The robot it belongs to, for joints and limits; None leaves those out.

    Returns:
        Findings in the order clock, reading, columns, units, channels, motion, and the numbers behind them.
    """
    findings, numbers = check_clock(log)
    findings += [
        CheckFinding("warning", "reading", sentence, "Let the logger finish its file.") for sentence in log.warnings
    ]
    findings += _columns(log, robot) + _units(log, robot)
    findings += [build_fault(warning) for warning in list_data_warnings(log, () if robot is None else robot.actuated)]
    parts = split_at_gaps(log)
    if not parts:
        lost = f"{log.name}: no stretch of it is without a gap."
        return LogCheck(log.name, (*findings, CheckFinding("fault", "gaps", lost, "Record it again.")), numbers)
    longest = int(np.argmax([part.n_samples for part in parts]))
    raw, part = parts[longest], resample_segments(log)[longest]
    moving = (
        {joint: find_moving_samples(part, joint) for joint in log.joints("q")}
        if part.n_samples == raw.n_samples
        else {}
    )
    findings += _jumps(raw, robot)
    for more, figures in (check_signals(raw, moving), check_motion(part)):
        findings += more
        numbers.update(figures)
    findings.append(_force_lag(log))
    return LogCheck(log.name, tuple(findings), numbers)


def _columns(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    """Compare the log's columns with what identification needs."""
    joints: Any = log.joints("q") if robot is None else tuple(robot.actuated)
    if not joints:
        return [
            CheckFinding(
                "fault",
                "columns",
                f"{log.name} has no q_ column; it has {format_names(log.channels)}.",
                "Log joint positions.",
            )
        ]
    findings = []
    wanted: tuple[tuple[str, Severity, str], ...] = (
        ("q", "fault", "position"),
        ("tau", "warning", "force, and identification needs it"),
    )
    for signal, severity, why in wanted:
        missing = [f"{signal}_{joint}" for joint in joints if not log.has(signal, [joint])]
        if missing:
            others = [joint for joint in log.joints(signal) if joint not in joints]
            instead = f" It has those of {format_names(others)}: another robot's log?" if others else ""
            sentence = f"{log.name} has no {format_names(missing)}: the joint's {why}.{instead}"
            findings.append(
                CheckFinding(severity, "columns", sentence, "Log it, or name it in a map (--columns MAP.yaml).")
            )
    return findings or [
        CheckFinding("ok", "columns", f"{log.name} has positions and forces of {format_names(joints)}.")
    ]


def _units(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    doubts = [
        CheckFinding(
            "warning" if robot is None else "fault",
            "units",
            sentence,
            "Give the map with --columns MAP.yaml.",
            "" if get_code(sentence) == UNCODED else get_code(sentence),
        )
        for sentence in list_unit_warnings(log, robot)
    ]
    return doubts or [CheckFinding("ok", "units", f"{log.name}: positions look like m and rad.")]


def _jumps(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    kinds = {} if robot is None else dict(zip(robot.actuated, robot.joint_kinds, strict=True))
    turns = {joint: kinds[joint] != "prismatic" if joint in kinds else None for joint in log.joints("q")}
    found = (check_jumps(log, joint, revolute=revolute) for joint, revolute in turns.items())
    return [finding for finding in found if finding is not None]


def _force_lag(log: Log) -> CheckFinding:
    sentence = f"{log.name}: a lag between force and motion was not tested; it takes the robot file."
    return CheckFinding("ok", "synchronisation", sentence)
