"""`tau-dyn payload` and `watch`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress

_STRETCH_S = 60.0
"""Length of the stretches in which a growing log is taken in [s]: the filters' edges cost a second of each."""
_POLL_S = 1.0  # between two looks at a growing log


def payload(
    robot: Annotated[str, args.describe_robot_or_model("whose friction then counts")],
    empty: Annotated[tuple[str, ...], Parameter(name="EMPTY")],
    /,
    *,
    loaded: Annotated[args.Strings, Parameter(metavar="LOG")] = (),
    link: str | None = None,
    columns: args.ColumnMapFile = None,
    exclude: Annotated[args.Strings, Parameter(metavar="COLUMN")] = (),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """Mass, centre and inertia of what the robot carries, from short motions without and with it.

    Args:
        empty: Logs without the payload; the same motion as with it, or another
        loaded: Logs with it
        link: Link that carries it (default: the one with the tool, or the tree's only leaf)
        exclude: Leave out samples where this column is not zero
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.monitor import identify_payload

        fitting = args.FittingOptions(columns=columns, exclude=exclude)
        without, with_it = fitting.read_logs(empty), fitting.read_logs(loaded)
        if args.is_saved_model(robot):
            machine = robot_options.load_model(robot)
        else:
            machine = robot_options.hold_silent_joints(robot_options.load(robot), robot, [*without, *with_it])
        found = identify_payload(machine, without, with_it, link=link, exclude=exclude, seed=output.seed, progress=step)
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[
            *robot_options.list_files(robot),
            *fitting.list_inputs("", [*empty, *loaded], [*without, *with_it]),
        ],
        found=found,
    )


def watch(
    model: Annotated[str, args.describe_robot_or_model("of the robot in its normal state")],
    logs: args.Logs,
    /,
    *,
    reference: Annotated[args.Positive, Parameter(metavar="S")] = 60.0,
    follow: Annotated[args.Positive | None, Parameter(metavar="S")] = None,
    columns: args.ColumnMapFile = None,
    exclude: Annotated[args.Strings, Parameter(metavar="COLUMN")] = (),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """What has changed on a robot since its normal state, and since when: friction, payload, encoder offset, delay.

    The status is 0 with or without an alarm.

    Args:
        model: An identified model file, or a robot's file
        reference: Motion from which the normal state is learned, at the beginning and after each alarm
        follow: The last log grows: go on until it has not grown for so long
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.monitor import watch_logs

        fitting = args.FittingOptions(columns=columns, exclude=exclude)
        machine = robot_options.load_model(model)
        read = fitting.read_logs(logs)
        stretches = read if follow is None else _follow(fitting, read, str(logs[-1]), follow)
        found = watch_logs(machine, stretches, reference_s=reference, exclude=exclude, progress=step)
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[*robot_options.list_files(model), *fitting.list_inputs("", logs, read)],
        found=found,
    )


def _follow(fitting: args.FittingOptions, read: list, path: str, patience_s: float) -> Iterator:
    """Yield logs, and of the last one, which grows, a stretch whenever one is complete; what is left when it has ended."""
    yield from read[:-1]
    log, done, seen, since = read[-1], 0, Path(path).stat().st_size, time.monotonic()
    while True:
        stretch = max(1, round(_STRETCH_S * log.rate_hz))
        while log.n_samples - done >= stretch:
            yield log[done : done + stretch]
            done += stretch
        if time.monotonic() - since > patience_s:
            break
        time.sleep(min(_POLL_S, patience_s))
        size = Path(path).stat().st_size
        if size != seen:
            seen, since = size, time.monotonic()
            (log,) = fitting.read_logs([path])
    if log.n_samples > done:
        yield log[done:]
