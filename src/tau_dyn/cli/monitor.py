"""`tau-dyn payload`, `watch` and `fleet`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_REFERENCE_S = 60.0  # s, equal to `tau_dyn.monitor.REFERENCE_S`, which is slow to import


def payload(
    robot: Annotated[str, args.describe_robot_or_model("whose effects and start values then count")],
    empty: Annotated[
        tuple[str, ...], Parameter(name="EMPTY", help="Logs without the payload: t, q_JOINT, tau_JOINT")
    ] = (),
    /,
    *,
    loaded: Annotated[args.Strings, Parameter(metavar="LOG")],
    link: Annotated[str | None, Parameter(metavar="LINK")] = None,
    columns: args.ColumnMapFile = None,
    exclude: Annotated[tuple[str, ...], Parameter(metavar="COLUMN")] = (),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """Mass, centre and inertia of a payload from logs without and with it, or a motion that would determine them.

    Args:
        loaded: Logs with the payload, of the same motion or another
        link: Link that carries it (default: the one with the tool, the only leaf, or a floating base)
        exclude: Leave out samples where this column is not zero
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.monitor import identify_payload

        options = args.FittingOptions(columns=columns, exclude=exclude)
        saved = args.is_saved_model(robot)
        machine = robot_options.load_model(robot) if saved else robot_options.load(robot, may_float=True)
        without, with_it = options.read_logs(empty), options.read_logs(loaded)
        found = identify_payload(machine, without, with_it, link=link, exclude=exclude, seed=output.seed, progress=step)
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[
            *robot_options.list_files(robot),
            *options.list_inputs("", [*empty, *loaded], [*without, *with_it]),
        ],
        found=found,
    )


def watch(
    model: Annotated[Path, Parameter(name="MODEL", help="MODEL.yaml of identify or diagnose: the normal robot")],
    logs: args.Logs,
    /,
    *,
    follow: bool = False,
    patience: Annotated[args.Positive, Parameter(metavar="S")] = 60.0,
    reference: Annotated[args.Positive, Parameter(metavar="S")] = _REFERENCE_S,
    columns: args.ColumnMapFile = None,
    exclude: Annotated[tuple[str, ...], Parameter(metavar="COLUMN")] = (),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """Changes of a robot and their times: friction, payload, an encoder's offset, a delay.

    At most one false alarm is expected in 10,000 hours of motion. The status is 0 with and without alarms.

    Args:
        follow: Continue to read the last LOG, a CSV file that is still written; Ctrl-C ends it
        patience: With --follow, end after this time without a new line
        reference: Duration of motion at the beginning, and after each alarm, that counts as normal
        exclude: Leave out samples where this column is not zero
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.model import Model
        from tau_dyn.monitor import GrowingFile, watch_logs

        if not logs:
            raise InputError("missing_input", "watch takes one log or more after the model")
        options = args.FittingOptions(columns=columns, exclude=exclude)
        normal = Model.load(model)
        finished = options.read_logs(logs[:-1] if follow else logs)
        growing = GrowingFile(Path(logs[-1]), columns, patience) if follow else None

        def read() -> Iterator[Any]:
            yield from finished
            if growing is not None:
                yield from growing.read()

        screen = Console(stderr=True, soft_wrap=True, highlight=False)

        def tell(row: dict[str, Any]) -> None:
            if follow:
                of = f" of {row['joint']}" if row["joint"] else ""
                screen.print(f"alarm: {row['what']}{of} {row['size']:+.3g} {row['unit']} since {row['since_t']:.6g} s")

        found = watch_logs(normal, read(), reference_s=reference, exclude=exclude, progress=step, alarm=tell)
    read_files = options.list_inputs("", logs[: len(finished)], finished)
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[model, *read_files, *([(logs[-1], growing.sha256)] if growing is not None else [])],
        found=found,
    )


def fleet(
    robot: args.RobotName,
    logs: Annotated[
        tuple[str, ...],
        Parameter(name="[UNIT=]LOG", help="Logs with torque; several of one unit as UNIT=LOG, else each is a unit"),
    ] = (),
    /,
    *,
    model: Annotated[str, Parameter(metavar="MODEL")] = "asymmetric",
    fitting: args.FittingOptions = args.FittingOptions(),
    out: Annotated[Path | None, args.build_destination("FLEET.yaml", "Write the fleet's model here")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Mean and spread of each parameter over units of one type, and outlying units.

    A new unit then needs little motion: tau-dyn identify ROBOT NEW.csv --model FLEET.yaml

    Args:
        model: Friction model, as identify takes it, or a model file
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.monitor import identify_fleet

        if not logs:
            raise InputError("missing_input", "fleet takes a log of each unit after the robot")
        pairs = [_split_unit(text) for text in logs]
        machine = robot_options.load(robot)
        read = fitting.read_logs([path for _, path in pairs])
        machine = robot_options.hold_silent_joints(machine, robot, read)
        units: dict[str, list[Any]] = {}
        for (unit, _), log in zip(pairs, read, strict=True):
            units.setdefault(unit, []).append(log)
        found = identify_fleet(machine, units, progress=step, **fitting.collect(model, output.seed))
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[*robot_options.list_files(robot), *fitting.list_inputs(model, [path for _, path in pairs], read)],
        files={out: found.model.save},
        named={"model": out},
        found=found,
    )


def _split_unit(text: str) -> tuple[str, str]:
    """Return unit and path of `[UNIT=]LOG`; a log without a unit is a unit of its own."""
    unit, equals, path = text.partition("=")
    return (unit, path) if equals and unit and not Path(text).exists() else (Path(text).stem, text)
