"""Springs of a robot from vibration records: one call from columns of logs at several poses to springs with intervals.

Every record is one pose. `channels.py` reads it, `problem.py` fits the springs to all records at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log
from tau_dyn.mechanism import FlexibleModel, get_rods, name_rod_spring, state_springs
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes.springs.channels import PosedRecord, build_posed_record
from tau_dyn.modes.springs.problem import START_SPACING, WINDOWS, SpringProblem
from tau_dyn.modes.springs.result import RecordFit, SpringFit
from tau_dyn.robot import Robot

STEPS = 15
"""Gauss-Newton steps for each `sigma` of the homotopy, and for each estimate of the noise."""
NOISE_ROUNDS = 4
"""Estimates of the noise in turn with the springs; the second one changes standard errors by less than 5 %."""
MIN_FIT_PERCENT = 50.0
"""Fit of a record's best output below which the robot's bodies and springs do not explain the record."""
_PLACEHOLDER = 1e8
"""Stiffness [N/m or N m/rad] of springs without a value until a start is found."""


def find_springs(
    robot: Robot,
    logs: Log | Sequence[Log],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    springs: Sequence[str] = ("file", "drives"),
    poses: Sequence[Mapping[str, float] | None] = (),
    holdout: Sequence[Log] = (),
    holdout_poses: Sequence[Mapping[str, float] | None] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> SpringFit:
    """Fit stiffness and damping of a robot's springs to vibration records, each at its own pose.

    Args:
        robot: The robot with its file's geometry and masses.
        logs: Records, such as hammer tests, each at one pose.
        inputs: Columns of forces [N, N m]: `fx_tool`, `fy_PLACE`, `tau_J`.
        outputs: Columns of responses [m, m/s, m/s^2, rad ..]: `ax_tool`, `x_PLACE`, `q_J`.
        springs: Springs to fit: `file` (those of the robot file), `drives` (all actuated joints), `rods`, or names and
            patterns of springs. Springs of the file that are not named keep their values; all else is rigid.
        poses: Position by actuated joint of each record; without, the means of its columns `q_J`.
        holdout: Records for evaluation only.
        holdout_poses: Their poses.
        seed: Kept with the result; the method is deterministic.
        progress: Called with a description of each step.

    Raises:
        InputError: A column, a pose or a spring does not fit the robot.
        CannotAnswer: The records determine no spring, or no springs explain them.
    """
    say = progress or (lambda step: None)
    logs, held = [logs] if isinstance(logs, Log) else list(logs), list(holdout)
    say("reading records")
    records = _build_records(robot, logs, inputs, outputs, poses)
    tested = _build_records(robot, held, inputs, outputs, holdout_poses)
    flexible, fitted, has_value = _free_springs(robot, springs)
    nominal = {s.joint: s.stiffness for s in (*robot.springs, *robot.drive_springs)}
    say("starting values")
    near = SpringProblem.build(flexible, fitted, records).start(has_value)
    for share in WINDOWS[1:]:
        say(f"fitting under an exponential window of {share:g} of the band")
        near = _descend_window(near, share)
    say("fitting all lines")
    if len(near) > 1:
        near = [_fit_lines(theta, problem, 1)[:2] for theta, problem in near]
        near = [min(near, key=lambda end: _measure_residual(end[1].judge(end[0], held_out=False)))]
    best = _build_result(*_fit_lines(*near[0], NOISE_ROUNDS), tested, nominal)
    best = replace(best, inputs=tuple(inputs), outputs=tuple(outputs), seed=seed)
    if _explain(best) < MIN_FIT_PERCENT:
        raise CannotAnswer(
            "no_solution",
            f"no springs were found that explain the records: the best fit explains {_explain(best):.0f} % of an output",
            "check masses, geometry and poses against the robot file; state approximate stiffnesses there, from which the fit "
            "begins",
        )
    if not best.list_identified():
        raise _refuse("the records determine the stiffness of no spring")
    return replace(best, warnings=tuple(_list_warnings(best)))


def _explain(found: SpringFit) -> float:
    """Return the share of a training record's best output that is explained [%]."""
    return max(max(record.fit_percent) for record in found.records if not record.held_out)


def _measure_residual(records: Sequence[RecordFit]) -> float:
    """Return the logarithm of the records' residual, summed over outputs."""
    left = [100 - x for record in records for x in record.fit_percent]
    return float(np.sum(np.log(np.maximum(left, 1e-9))))


def _descend_window(
    starts: Sequence[tuple[np.ndarray, SpringProblem]], share: float
) -> list[tuple[np.ndarray, SpringProblem]]:
    """Return the distinct ends of fits under a window of a share of the band: values (t,) and the problem there."""
    ends: list[tuple[np.ndarray, SpringProblem]] = []
    for theta, problem in starts:
        theta = problem.descend(theta, problem.transform_all(share), STEPS)[0]
        if not any(np.abs(theta - other)[: problem.n].max() < START_SPACING for other, _ in ends):
            ends.append((theta, problem.move(theta)))
    return ends


def _fit_lines(
    theta: np.ndarray, problem: SpringProblem, rounds: int
) -> tuple[np.ndarray, SpringProblem, np.ndarray, int]:
    """Return the values (t,), the problem there, the information (t, t) and the last steps of a fit of all lines.

    Args:
        theta: Start (t,).
        problem: The problem there.
        rounds: Estimates of the noise, in turn with the springs.
    """
    information, steps, data = np.eye(len(theta)), 0, problem.transform_all(0.0)
    for _ in range(rounds):
        theta, information, steps = problem.descend(theta, data, STEPS)
        try:
            problem = problem.linearise(theta)
        except InputError as fault:
            raise _refuse(str(fault.args[0])) from fault
    return theta, problem, information, steps


def _build_result(
    theta: np.ndarray,
    problem: SpringProblem,
    information: np.ndarray,
    steps: int,
    tested: Sequence[PosedRecord],
    nominal: Mapping[str, float],
) -> SpringFit:
    """Return the springs at the end of a fit; the caller adds the names of the columns."""
    covariance = np.linalg.inv(information)
    errors = np.sqrt(np.diag(covariance)[: problem.n])
    return SpringFit(
        problem.flexible.robot,
        tuple(problem.list_fitted(theta, covariance, nominal)),
        covariance[: len(errors), : len(errors)] / np.outer(errors, errors),
        (),
        (),
        (*problem.judge(theta, held_out=False), *problem.at_records(tested, theta).judge(theta, held_out=True)),
        steps,
        steps < STEPS,
    )


def _refuse(why: str) -> CannotAnswer:
    return CannotAnswer(
        "poor_excitation", why, "blows in more directions and places, at more poses, where the wanted springs yield"
    )


def _list_warnings(found: SpringFit) -> list[str]:
    """Return sentences about springs that are not determined, negative damping, and records that are not explained."""
    out = []
    if weak := found.list_not_identified():
        out.append(
            CodedWarning(
                "springs_not_identified",
                f"no record determines the stiffness of {', '.join(weak)} (standard error above 30 %)",
                tuple(weak),
            )
        )
    if negative := [s.spring.joint for s in found.springs if s.spring.damping < 0]:
        out.append(f"the damping of {', '.join(negative)} is estimated below zero; a robot file states zero for it")
    for record in found.records:
        if max(record.fit_percent) < MIN_FIT_PERCENT:
            out.append(
                CodedWarning(
                    "poor_fit",
                    f"{record.log}: the springs explain {max(record.fit_percent):.0f} % of its best output; masses, "
                    "geometry, pose or other springs differ from the robot file",
                )
            )
    if not found.converged:
        out.append(f"no convergence in {NOISE_ROUNDS * STEPS} iterations; standard errors are those of the last one")
    return out


def _build_records(
    robot: Robot,
    logs: Sequence[Log],
    inputs: Sequence[str],
    outputs: Sequence[str],
    poses: Sequence[Mapping[str, float] | None],
) -> list[PosedRecord]:
    if poses and len(poses) != len(logs):
        raise InputError("mismatch", f"{len(poses)} pose(s) for {len(logs)} record(s); give one each")
    given = poses or [None] * len(logs)
    return [build_posed_record(robot, log, inputs, outputs, pose) for log, pose in zip(logs, given, strict=True)]


def _free_springs(robot: Robot, wanted: Sequence[str]) -> tuple[FlexibleModel, np.ndarray, np.ndarray]:
    """Return the robot with all its springs, which of them (ns,) are fitted, and which fitted ones have a value (n,).

    Raises:
        InputError: A name fits no spring.
    """
    in_file = {s.joint for s in robot.springs}, {s.joint for s in robot.drive_springs}
    rods = get_rods(robot)
    slides = set() if rods is None else {name_rod_spring(name) for name in rods.names}
    if "rods" in wanted and not slides <= in_file[0]:
        robot = state_springs(robot, rods=_PLACEHOLDER)
    drives = [j for j in robot.actuated if j not in in_file[1]] if "drives" in wanted else []
    robot = state_springs(robot, drives=dict.fromkeys(drives, _PLACEHOLDER)) if drives else robot
    if not (robot.springs or robot.drive_springs):
        raise InputError(
            "bad_option", f"{robot.source} states no springs; there are file, drives, rods: fit drives or rods"
        )
    flexible = FlexibleModel(robot)
    kinds = [(s.joint, k >= len(robot.springs)) for k, s in enumerate(flexible.springs)]
    stated = np.array([joint in in_file[drive] for joint, drive in kinds])
    fitted = np.zeros(len(kinds), bool)
    for name in wanted:
        groups = {
            "file": stated,
            "drives": np.array([drive for _, drive in kinds]),
            "rods": np.array([joint in slides for joint, _ in kinds]),
        }
        hits = groups.get(name, np.array([fnmatchcase(joint, name) for joint, _ in kinds]))
        if name != "file" and not hits.any():
            names = ", ".join(joint for joint, _ in kinds)
            raise InputError("bad_option", f"springs '{name}': there are file, drives, rods, and by name {names}")
        fitted |= hits
    return flexible, fitted, stated[fitted]
