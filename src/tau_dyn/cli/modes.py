"""`tau-dyn modes`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_COLUMNS = Group("Columns, by name")


def modes(
    logs: Annotated[tuple[str, ...], Parameter(name="LOG")],
    /,
    *,
    inputs: Annotated[args.Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    outputs: Annotated[args.Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    reference: Annotated[args.Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    holdout: Annotated[args.Strings, Parameter(metavar="LOG")] = (),
    columns: args.ColumnMapFile = None,
    method: Annotated[str, Parameter(metavar="METHOD")] = "auto",
    order: Annotated[str, Parameter(metavar="N")] = "auto",
    delay: Annotated[str, Parameter(metavar="N")] = "auto",
    sensor: Literal["auto", "displacement", "velocity", "acceleration"] = "auto",
    collocated: Annotated[args.Strings, Parameter(metavar="INPUT:OUTPUT")] = (),
    time_limit: Annotated[args.Positive | None, Parameter(metavar="SECONDS")] = None,
    robot: Annotated[str | None, Parameter(metavar="ROBOT")] = None,
    springs: Annotated[args.Strings, Parameter(metavar="SPRING")] = (),
    poses: Annotated[Path | None, Parameter(metavar="POSES.yaml")] = None,
    out: Annotated[
        Path | None,
        args.build_destination("MODEL", "Write the black-box model here (YAML), with --springs the robot (URDF)"),
    ] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Resonances from vibration logs, with uncertainty; a black-box model; M, D and K if the data determine them.

    Args:
        logs: CSV, Parquet, MCAP, a ROS bag, .mat or .unv with t and any columns; never joined
        inputs: Excitations; without any, operational modal analysis of the outputs (logs with other outputs are further
            set-ups, joined by the common outputs)
        outputs: Responses; if as many as inputs and in their order, they are assumed to be measured where the forces act
        reference: Reference of the feedback loop, if the loop was closed
        holdout: Held-out logs, for evaluation only (without any, the last 30 % of each log)
        method: auto, n4sid, pbsid (valid under feedback), arx or era (impulse tests)
        order: Number of states; auto chooses
        delay: Delay of the inputs in samples
        sensor: Quantity of the outputs, for mass, damping and stiffness; auto uses their names (acc1_g, ax_tool, x_tool) or
            the best fit
        collocated: Pairs at the same point and in the same direction, for mass, damping and stiffness (default: inputs and
            outputs in their order, if equally many)
        time_limit: Wall time after which no more models are tried; the best model so far is the answer
        robot: Draw the modes on this robot (outputs named x_tool, ay_plate, ...); with springs in its file also its own
            modes
        springs: With --robot, fit springs to all logs, each at its own pose: file (those of the robot file), drives, rods,
            or names and patterns
        poses: Poses of the logs, LOG: {JOINT: VALUE} (default: the means of their columns q_J)
    """
    if springs:
        ignored = {"--reference": reference, "--collocated": collocated, "--method": method != "auto", "--order": order != "auto",
                   "--delay": delay != "auto", "--sensor": sensor != "auto", "--time-limit": time_limit is not None}  # fmt: skip
        if robot is None or not inputs or any(ignored.values()):
            wrong = next((name for name, value in ignored.items() if value), "")
            why = f"it takes no {wrong}" if wrong else "it needs --robot ROBOT and --inputs"
            raise InputError("bad_option", f"--springs fits the springs of a robot: {why}")
        return _fit_springs(
            robot, (logs, holdout), (inputs, outputs), springs, poses, columns, out, robot_options, output
        )
    if poses is not None:
        raise InputError("bad_option", "--poses goes with --springs")
    options = {
        "--out": out,
        "--holdout": holdout,
        "--reference": reference,
        "--collocated": collocated,
        f"--method {method}": method != "auto",
        f"--delay {delay}": delay != "auto",
        "--time-limit": time_limit is not None,
    }
    given = next((name for name, value in options.items() if value), None)
    if not inputs and given is not None:
        raise InputError("bad_option", f"{given} needs what excites: name it with --inputs")
    if robot is None and (robot_options.set or robot_options.actuated):
        raise InputError("bad_option", "--set and --actuated control how a robot is loaded; name it with --robot ROBOT")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.log import read_log
        from tau_dyn.modes import find_modes, find_operational_modes, save_state_space

        machine = None if robot is None else robot_options.load(robot)
        trained, held = ([read_log(path, columns) for path in paths] for paths in (logs, holdout))
        if inputs:
            found = find_modes(
                trained,
                list(inputs),
                list(outputs),
                holdout=held,
                references=list(reference),
                method=method,
                order=order,
                delay=delay,
                sensor=sensor,
                collocated=[_split_pair(pair) for pair in collocated],
                time_limit=time_limit,
                seed=output.seed,
                progress=step,
            )
        else:
            step("operational modal analysis")
            found = find_operational_modes(trained, list(outputs), order=order, seed=output.seed)
    on_robot, warned = _project(machine, found)
    read = [(str(path), log.sha256) for path, log in zip([*logs, *holdout], [*trained, *held], strict=True)]

    def save(path: Path) -> None:
        save_state_space(path, found.model_file([{"path": name, "sha256": sha256} for name, sha256 in read]))

    return Outcome(
        result=found.to_dict() | ({} if on_robot is None else {"robot_modes": on_robot.to_list()}),
        warnings=[*(w for log in (*trained, *held) for w in log.warnings), *found.warnings, *warned],
        inputs=[*read, columns, *(robot_options.list_files(robot) if robot else [])],
        files={out: save},
        named={"model": out},
        found=found,
        context={"on_robot": on_robot, "logs": read},
    )


def _fit_springs(robot, paths, names, springs, poses, columns, out, robot_options, output) -> Outcome:
    """Return the springs of a robot that records at several poses show."""
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.files import write_whole
        from tau_dyn.log import read_log
        from tau_dyn.modes import find_springs

        machine = robot_options.load(robot)
        known = {} if poses is None else _read_poses(poses)
        trained, held = ([read_log(path, columns) for path in some] for some in paths)
        at_trained, at_held = ([_find_pose(known, path) for path in some] for some in paths)
        found = find_springs(
            machine, trained, *map(list, names), springs=springs, poses=at_trained, holdout=held, holdout_poses=at_held,
            seed=output.seed, progress=step,
        )  # fmt: skip
    read = [(str(path), log.sha256) for path, log in zip([*paths[0], *paths[1]], [*trained, *held], strict=True)]
    return Outcome(
        result=found.to_dict(),
        warnings=[*machine.warnings, *(w for log in (*trained, *held) for w in log.warnings), *found.warnings],
        inputs=[*read, columns, poses, *robot_options.list_files(robot)],
        files={out: lambda path: write_whole(path, found.build_robot().urdf)},
        named={"robot": out},
        found=found,
        context={"logs": read},
    )


def _read_poses(path: Path) -> dict[str, dict[str, float]]:
    """Return the position by joint of each log in a YAML file."""
    from tau_dyn.files import read_yaml

    content, found = read_yaml(path), {}
    if not isinstance(content, dict):
        raise InputError("file_format", f"{path}: poses are lines LOG: {{JOINT: VALUE, ..}} in m or rad")
    for name, pose in content.items():
        values: dict[Any, Any] = pose if isinstance(pose, dict) else {"": None}
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values.values()):
            raise InputError(
                "file_format", f"{path}: '{name}' has no pose; write LOG: {{JOINT: VALUE, ..}} in m or rad"
            )
        found[str(name)] = {str(j): float(v) for j, v in values.items()}
    return found


def _find_pose(known: dict[str, dict[str, float]], log: str) -> dict[str, float] | None:
    """Return a log's pose by its path, its file name, or its name without ending."""
    path = Path(log)
    return next((known[name] for name in (str(log), path.name, path.stem) if name in known), None)


def _project(robot, found):
    """Return the modes on the robot, and a warning if they were requested but cannot be drawn."""
    if robot is None:
        return None, []
    from tau_dyn.modes import project_shapes_on_robot

    shapes = project_shapes_on_robot(robot, found.modes, found.outputs)
    why = f"no mode is drawn on {robot.name}: outputs are drawn where they are named by axis and place, such as x_tool"
    return shapes, [] if shapes or not found.modes else [why]


def _split_pair(text: str) -> tuple[str, str]:
    one, colon, other = text.partition(":")
    if not colon:
        raise InputError("bad_option", f"--collocated {text}: write INPUT:OUTPUT, two columns at one place")
    return one, other
