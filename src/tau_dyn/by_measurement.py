"""`identify` and `diagnose` for whatever logs hold: forces, or commands and positions without forces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Unpack, overload

from tau_dyn.diagnose import diagnose as diagnose_forces
from tau_dyn.evidence import Diagnosis
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Identification, get_log_list, identify as identify_forces
from tau_dyn.log import Log, Recording
from tau_dyn.robot import Robot
from tau_dyn.servo import LoopIdentification, LoopOptions, diagnose_loop, identify_loop, is_loop_log
from tau_dyn.simulate import ServoLaw, read_servo_law

Logs = Log | Recording | Iterable[Log | Recording]
Controller = ServoLaw | str | Path | None
_NOT_SAID: Any = object()


@overload
def identify(robot: Robot, logs: Logs, **options: Any) -> Identification: ...
@overload
def identify(
    robot: Robot, logs: Logs, *, controller: Controller, **options: Unpack[LoopOptions]
) -> LoopIdentification: ...
def identify(robot: Robot, logs: Logs, *, controller: Controller = _NOT_SAID, **options: Any) -> Any:
    """Identify a robot's parameters from logs of forces, or, without forces, through its servo loops.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `q_J` and `tau_J` of every actuated joint; or with `q_J` and `cmd_J` and no force.
        controller: The servo's law or its file, for logs without forces; None to estimate its gains. Saying it, be it
            None, tells a type checker that the answer is a `LoopIdentification`.
        **options: Those of `tau_dyn.identify.identify`, or of `tau_dyn.servo.LoopOptions`.

    Raises:
        InputError: A log, the model, the law or a choice is at fault.
        CannotAnswer: The logs determine nothing.

    Example:
        >>> t, w = np.arange(0.0, 10.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> log = td.Log(t, {"q_axis": q, "tau_axis": 90.0 * a + 20.0 * np.sign(v)})
        >>> round(td.identify(td.load_robot("linear_axis"), log).parameters["carriage_link.mass"].value, 1)
        90.0
    """
    given = get_log_list(logs)
    if given and is_loop_log(given[0], robot):
        return identify_loop(robot, given, **_read_law(controller, robot), **options)
    _refuse_law(controller, given)
    return identify_forces(robot, given, **options)


@overload
def diagnose(robot: Robot | Identification, logs: Logs = (), **options: Any) -> Diagnosis: ...
@overload
def diagnose(
    robot: Robot | LoopIdentification, logs: Logs = (), *, controller: Controller, **options: Unpack[LoopOptions]
) -> Diagnosis: ...
def diagnose(
    robot: Robot | Identification | LoopIdentification,
    logs: Logs = (),
    *,
    controller: Controller = _NOT_SAID,
    **options: Any,
) -> Any:
    """Find out what a simulation gets wrong, and why, from logs of forces or, without forces, through the servo loops.

    Args:
        robot: The robot, or an identification, whose logs (and law) are then taken.
        logs: Logs to train on, with `q_J` and `tau_J` of every actuated joint; or with `q_J` and `cmd_J` and no force.
        controller: The servo's law or its file, for logs without forces; None where nothing is known of it.
        **options: Those of `tau_dyn.diagnose.diagnose`, or of `tau_dyn.servo.LoopOptions`.

    Raises:
        InputError: A log, the model, the law or a choice is at fault.
        CannotAnswer: The logs determine nothing, or are too short for three parts.

    Example:
        >>> t, w = np.arange(0.0, 20.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> rng, stribeck = np.random.default_rng(0), 30.0 * np.sign(v) * np.exp(-np.abs(v) / 0.05)
        >>> tau = 95.0 * a + 20.0 * np.sign(v) + stribeck + rng.normal(size=t.size)
        >>> why = td.diagnose(td.load_robot("linear_axis"), td.Log(t, {"q_axis": q, "tau_axis": tau}))
        >>> why.verdict, why.findings[0].cause
        ('named', 'stribeck')
    """
    if isinstance(robot, LoopIdentification):
        start = robot.start[0]
        law = start.law if controller is _NOT_SAID else controller
        return diagnose(start.model.robot, logs or robot.logs, controller=law, **options)
    machine = robot
    given = get_log_list(logs)
    if isinstance(machine, Robot) and given and is_loop_log(given[0], machine):
        return diagnose_loop(machine, given, **_read_law(controller, machine), **options)
    _refuse_law(controller, given)
    return diagnose_forces(machine, given, **options)


def _read_law(controller: Controller, robot: Robot) -> LoopOptions:
    if controller is _NOT_SAID or controller is None:
        return {}
    return {"law": controller if isinstance(controller, ServoLaw) else read_servo_law(controller, robot)}


def _refuse_law(controller: Controller, logs: Sequence[Log | Recording]) -> None:
    if controller is not _NOT_SAID and controller is not None:
        name = logs[0].name if logs else "no log"
        raise InputError("bad_option", f"a controller goes with logs of commands without forces; {name} is none")
