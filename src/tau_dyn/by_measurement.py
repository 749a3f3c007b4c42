"""`identify` and `diagnose` for logs with forces, or with commands and positions but without forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import signature
from numbers import Integral
from pathlib import Path
from typing import Any, TypedDict, Unpack, overload

from tau_dyn.diagnose import diagnose as diagnose_forces
from tau_dyn.effects import FRICTION_MODELS
from tau_dyn.evidence import Diagnosis
from tau_dyn.exceptions import InputError, UnknownName, require_kind, require_names
from tau_dyn.identify import Choices, Identification, Logs, Preparation, get_log_list, identify as identify_forces
from tau_dyn.log import Log, Recording
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot, as_robot, load_robot_from_urdf
from tau_dyn.servo import LoopIdentification, LoopOptions, diagnose_loop, identify_loop, is_loop_log
from tau_dyn.simulate import ServoLaw, read_servo_law

Controller = ServoLaw | str | Path | None


class _NotGiven:
    """The default of an argument for which None has a meaning; its text is shown by `help`."""

    def __repr__(self) -> str:
        return "<not given>"


_NOT_GIVEN: Any = _NotGiven()


class ForceOptions(TypedDict, total=False):
    """Options for logs of forces; each has a default.

    Attributes:
        holdout: Logs for the evaluation only.
        model: `rigid`, `symmetric`, `asymmetric`, a model file, or a model.
        choices: Parameters that are fixed, free, bounded or measured in advance.
        preparation: Filters and masks; by default chosen from the training logs.
        exclude: Log columns whose nonzero samples are left out.
        seed: Seed of all random numbers.
        progress: Called with a word for each step.
    """

    holdout: Logs
    model: str | Path | Model
    choices: Choices | None
    preparation: Preparation | None
    exclude: tuple[str, ...]
    seed: int
    progress: Callable[[str], None]


class IdentifyOptions(ForceOptions, total=False):
    """Options of `identify` alone.

    Attributes:
        per_log: Names or patterns of parameters with a value for each log.
        estimator: `auto`, `wls`, `ml`, `iv` or `robust`.
    """

    per_log: Sequence[str]
    estimator: str


_KINDS: dict[str, tuple[Any, str, str]] = {
    "model": (str | Path | Model, "friction model", "rigid, symmetric, asymmetric, a model file or a Model"),
    "choices": (Choices | None, "set of choices", "Choices(...)"),
    "preparation": (Preparation | None, "preparation", "a Preparation"),
    "seed": (Integral, "seed", "a whole number"),
    "progress": (Callable, "progress", "a function of one word"),
    "estimator": (str, "estimator", "auto, wls, ml, iv or robust"),
}
"""Options, the types that they take, what they are and what to give."""


def _require_options(function: Callable[..., Any], options: dict[str, Any]) -> None:
    """Refuse an option that a function does not have, and name those that it has; refuse a value of another type.

    Raises:
        UnknownName: Lists the options.
        InputError: A value has another type than its option takes.
    """
    known = [name for name, p in signature(function).parameters.items() if p.kind is p.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            raise UnknownName("option", name, known)
        if name in _KINDS:
            require_kind(options[name], *_KINDS[name])
        elif name in ("exclude", "per_log"):
            require_names(options[name], name)
            options[name] = tuple(options[name])


@overload
def identify(robot: Robot | str | Path, logs: Logs, **options: Unpack[IdentifyOptions]) -> Identification: ...
@overload
def identify(
    robot: Robot | str | Path, logs: Logs, *, controller: Controller, **options: Unpack[LoopOptions]
) -> LoopIdentification: ...
def identify(robot: Robot | str | Path, logs: Logs, *, controller: Controller = _NOT_GIVEN, **options: Any) -> Any:
    """Identify a robot's parameters from logs of forces, or, without forces, through its servo loops.

    Args:
        robot: The robot, with nominal parameters; or its file's path, or a short name.
        logs: Training logs with `q_J` and `tau_J` of every actuated joint; or with `q_J` and `cmd_J` and no force. Each is a log,
            the path of a file, or a table of pandas.
        controller: The servo's law or its file, for logs without forces; None to estimate its gains. If it is passed, even as
            None, type checkers infer a `LoopIdentification`.
        **options: `holdout`, `model`, `choices`, `preparation`, `exclude`, `seed`, `progress`, `per_log` and `estimator`, as
            `IdentifyOptions` describes them; those of `tau_dyn.servo.LoopOptions` for logs without forces.

    Raises:
        InputError: A log, the model, the law or a choice is invalid.
        CannotAnswer: The logs determine no parameter.

    Example:
        >>> t, w = np.arange(0.0, 10.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> log = td.Log(t, {"q_axis": q, "tau_axis": 90.0 * a + 20.0 * np.sign(v)})
        >>> round(td.identify(td.load_robot("linear_axis"), log).parameters["carriage_link.mass"].value, 1)
        90.0
    """
    machine, given = as_robot(robot), get_log_list(logs)
    if given and is_loop_log(given[0], machine):
        return identify_loop(machine, given, **_read_law(controller, machine), **options)
    _refuse_law(controller, given)
    _require_options(identify_forces, options)
    return identify_forces(machine, given, **options)


@overload
def diagnose(
    robot: Robot | Identification | str | Path, logs: Logs = (), **options: Unpack[ForceOptions]
) -> Diagnosis: ...
@overload
def diagnose(
    robot: Robot | LoopIdentification | str | Path,
    logs: Logs = (),
    *,
    controller: Controller,
    **options: Unpack[LoopOptions],
) -> Diagnosis: ...
def diagnose(
    robot: Robot | Identification | LoopIdentification | str | Path,
    logs: Logs = (),
    *,
    controller: Controller = _NOT_GIVEN,
    **options: Any,
) -> Any:
    """Find the errors of a model and their causes, from logs of forces or, without forces, through the servo loops.

    Args:
        robot: The robot, its file's path or a short name; or an identification, whose logs (and law) are then taken.
        logs: Logs to train on, with `q_J` and `tau_J` of every actuated joint; or with `q_J` and `cmd_J` and no force.
        controller: The servo's law or its file, for logs without forces; None if it is unknown.
        **options: `holdout`, `model`, `choices`, `preparation`, `exclude`, `seed` and `progress`, as `ForceOptions` describes
            them; those of `tau_dyn.servo.LoopOptions` for logs without forces.

    Raises:
        InputError: A log, the model, the law or a choice is invalid.
        CannotAnswer: The logs determine no parameter, or are too short for three parts.

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
        law = start.law if controller is _NOT_GIVEN else controller
        return diagnose(start.model.robot, logs or robot.logs, controller=law, **options)
    machine = robot if isinstance(robot, Identification) else as_robot(robot)
    given = get_log_list(logs)
    if isinstance(machine, Robot) and given and is_loop_log(given[0], machine):
        return diagnose_loop(machine, given, **_read_law(controller, machine), **options)
    _refuse_law(controller, given)
    _require_options(diagnose_forces, options)
    return diagnose_drives(machine, given, **options)


def diagnose_drives(robot: Robot | Identification, logs: Sequence[Log | Recording], **options: Any) -> Diagnosis:
    """Find the errors of a model of forces; with more drives than freedoms, look for causes at each of the drives.

    A search looks at the actuated joints, and a cause at a redundant drive takes the name of another one there. So unless
    nothing is found, the search is repeated with the redundant drives in the place of others. The one is reported whose confirmed
    causes have the largest score on the data that were searched; errors on test data decide nothing. Models from a file are
    searched once, with the drives that they name first.

    Args:
        robot: The robot, or an identification.
        logs: Logs to train on.
        **options: Those of `tau_dyn.diagnose.diagnose`.

    Raises:
        InputError: A log, the model or a choice is invalid.
        CannotAnswer: The logs determine no parameter, or are too short for three parts.
    """
    first = diagnose_forces(robot, logs, **options)
    model = options.get("model", "asymmetric")
    named = isinstance(model, str) and model in FRICTION_MODELS
    if not isinstance(robot, Robot) or not robot.redundant_joints or not named or first.verdict == "nothing_found":
        return first
    others = _list_other_drives(robot)
    found = [first, *(diagnose_forces(other, logs, **options) for other in others)]
    scores = [sum(f.score for f in one.findings if f.status == "confirmed") for one in found]
    best = found[scores.index(max(scores))]
    errors = [
        f"{' and '.join(machine.actuated)} ({one.extended.relative_error_percent:.3g} % left)"
        for machine, one in zip((robot, *others), found, strict=True)
    ]
    where = " and ".join(best.model.robot.actuated)
    sentence = f"causes were looked for at {'; at '.join(errors)}; reported are those at {where}"
    return replace(best, warnings=(*best.warnings, CodedWarning("redundant_drives", sentence)))


def _list_other_drives(robot: Robot) -> list[Robot]:
    """Return the robot with redundant drives as actuated joints, until each drive has been one."""
    found, left = [], list(robot.redundant_joints)
    while left:
        order = [*left, *(joint for joint in (*robot.actuated, *robot.redundant_joints) if joint not in left)]
        other = load_robot_from_urdf(
            robot.urdf,
            robot.source,
            actuated=order,
            tool=robot.tool or None,
            arguments=robot.arguments,
            sha256=robot.sha256,
            packages=robot.packages,
        )
        parameters = [robot.parameters[p.name] if p.name in robot.parameters else p for p in other.parameters]
        remaining = [joint for joint in left if joint in other.redundant_joints]
        if remaining == left:
            break
        found.append(other.with_parameters(Parameters(parameters)))
        left = remaining
    return found


def _read_law(controller: Controller, robot: Robot) -> LoopOptions:
    if controller is _NOT_GIVEN or controller is None:
        return {}
    return {"law": controller if isinstance(controller, ServoLaw) else read_servo_law(controller, robot)}


def _refuse_law(controller: Controller, logs: Sequence[Log | Recording]) -> None:
    if controller is not _NOT_GIVEN and controller is not None:
        name = logs[0].name if logs else "no log"
        raise InputError("bad_option", f"a controller goes with logs of commands without forces; {name} is none")
