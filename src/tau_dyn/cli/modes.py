"""Resonances from vibration logs, with uncertainty; a black-box model; mass, damping and stiffness where the data hold them."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot_options,
    format_command_line,
    get_robot_file,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.exceptions import InputError

HELP = "resonances and black-box models from vibration logs"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        help="CSV, Parquet, MCAP, a ROS bag or .mat with t and any columns; never joined",
    )
    _add_columns(parser.add_argument_group("columns, by name"))
    parser.add_argument(
        "--holdout",
        metavar="LOG",
        nargs="+",
        action="extend",
        default=[],
        help="held-out logs, for evaluation only (without any, the last 30 %% of each log)",
    )
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="how to read foreign column names and units")
    _add_model(parser)
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="draw the modes on this robot (outputs named x_tool, ay_plate, ...); with springs in its file also its own modes",
    )
    add_robot_options(parser)
    parser.add_argument("--out", metavar="MODEL.yaml", type=Path, help="write the black-box model here")
    add_common(parser)


def _add_columns(group: argparse._ArgumentGroup) -> None:
    for name, text in (
        ("inputs", "what excites; without any, operational modal analysis of the outputs"),
        (
            "outputs",
            "what responds; as many as inputs and in their order, they are taken as measured where the forces act",
        ),
        ("reference", "what a feedback loop was asked to follow, where one was closed"),
    ):
        group.add_argument(f"--{name}", metavar="COLUMN", nargs="+", action="extend", default=[], help=text)


def _add_model(parser: argparse.ArgumentParser) -> None:
    """Add what is chosen about the model."""
    parser.add_argument(
        "--method",
        default="auto",
        metavar="METHOD",
        help="auto (default), n4sid, pbsid (valid under feedback), arx or era (impulse tests)",
    )
    parser.add_argument("--order", default="auto", metavar="N", help="number of states; auto (default) chooses")
    parser.add_argument("--delay", default="auto", metavar="N", help="delay of the inputs in samples; auto (default)")
    parser.add_argument(
        "--sensor",
        default="displacement",
        choices=("displacement", "velocity", "acceleration"),
        help="what the outputs are, for mass, damping and stiffness",
    )
    parser.add_argument(
        "--collocated",
        metavar="INPUT:OUTPUT",
        nargs="+",
        action="extend",
        default=[],
        help="pairs at one place and in one direction, for mass, damping and stiffness (default: inputs and outputs in their "
        "order, where as many)",
    )


def run(args: argparse.Namespace) -> Outcome:
    """Find modes."""
    if not args.inputs:
        return _run_operational(args)
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.log import read_log
        from tau_dyn.modes import find_modes

        robot = load_robot_from(args) if _robot_asked(args) else None
        logs = [read_log(path, args.columns) for path in args.logs]
        held = [read_log(path, args.columns) for path in args.holdout]
        found = find_modes(
            logs,
            args.inputs,
            args.outputs,
            holdout=held,
            references=args.reference,
            method=args.method,
            order=args.order,
            delay=args.delay,
            sensor=args.sensor,
            collocated=[_pair(pair) for pair in args.collocated],
            seed=args.seed,
            progress=step,
        )
    on_robot, warned = _on_robot(robot, found)
    read = [(str(path), log.sha256) for path, log in zip([*args.logs, *args.holdout], [*logs, *held], strict=True)]
    return Outcome(
        result=found.to_dict() | ({} if on_robot is None else {"robot_modes": on_robot.to_list()}),
        warnings=[*(w for log in (*logs, *held) for w in log.warnings), *found.warnings, *warned],
        inputs=[*read, *([args.columns] if args.columns else []), *(get_robot_file(args) if robot else [])],
        show=lambda console: _show(console, found, args),
        files={args.out: lambda path: _save(path, found, read)} if args.out else {},
        report=lambda: _page(found, on_robot, read),
    )


def _run_operational(args: argparse.Namespace) -> Outcome:
    """Find modes from responses alone."""
    options = {
        "--out": args.out,
        "--holdout": args.holdout,
        "--reference": args.reference,
        "--collocated": args.collocated,
        f"--method {args.method}": args.method != "auto",
        f"--delay {args.delay}": args.delay != "auto",
    }
    given = next((name for name, value in options.items() if value), None)
    if given is not None:
        raise InputError("bad_option", f"{given} needs what excites: name it with --inputs")
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.log import read_log
        from tau_dyn.modes import find_operational_modes

        robot = load_robot_from(args) if _robot_asked(args) else None
        logs = [read_log(path, args.columns) for path in args.logs]
        step("operational modal analysis")
        found = find_operational_modes(logs, args.outputs, order=args.order, seed=args.seed)
    on_robot, warned = _on_robot(robot, found)
    read = [(str(path), log.sha256) for path, log in zip(args.logs, logs, strict=True)]
    return Outcome(
        result=found.to_dict() | ({} if on_robot is None else {"robot_modes": on_robot.to_list()}),
        warnings=[*(w for log in logs for w in log.warnings), *found.warnings, *warned],
        inputs=[*read, *([args.columns] if args.columns else []), *(get_robot_file(args) if robot else [])],
        show=lambda console: _show_operational(console, found, args),
        report=lambda: _operational_page(found, on_robot, read),
    )


def _robot_asked(args: argparse.Namespace) -> bool:
    if args.robot is None and (args.set or args.actuated):
        raise InputError("bad_option", "--set and --actuated say how to load a robot; name it with --robot ROBOT")
    return args.robot is not None


def _on_robot(robot, found):
    """Return the modes on the robot, and a warning where it was asked for and nothing can be drawn."""
    from tau_dyn.modes import project_shapes_on_robot

    if robot is None:
        return None, []
    shapes = project_shapes_on_robot(robot, found.modes, found.outputs)
    why = f"no mode is drawn on {robot.name}: outputs are drawn where they are named by axis and place, such as x_tool"
    return shapes, [] if shapes or not found.modes else [why]


def _pair(text: str) -> tuple[str, str]:
    one, colon, other = text.partition(":")
    if not colon:
        raise InputError("bad_option", f"--collocated {text}: write INPUT:OUTPUT, two columns at one place")
    return one, other


def _save(path: Path, found, read: list[tuple[str, str]]) -> None:
    from tau_dyn.modes import save_state_space

    save_state_space(path, found.model_file([{"path": name, "sha256": sha256} for name, sha256 in read]))


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, found, list_written_files(args, model=args.out))


def _show_operational(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, found, list_written_files(args))


def _operational_page(found, on_robot, read: list[tuple[str, str]]) -> str:
    from tau_dyn.render import build_page

    return build_page(found, on_robot=on_robot, logs=read, command_line=format_command_line())


def _page(found, on_robot, read: list[tuple[str, str]]) -> str:
    from tau_dyn.render import build_page

    return build_page(found, on_robot=on_robot, logs=read, command_line=format_command_line())
