"""`tau-dyn view`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_HERE = ("127.0.0.1", "localhost", "::1")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Contents:
    """What the window shows beside the robot, and where it opens.

    Attributes:
        simulated: The same motion simulated, as a ghost (default: its references)
        columns: Column map of a foreign log
        result: Results to show: --json of diagnose, workspace, accuracy, calibrate, modes, identify
        compute: Work out what a result lacks: points of a workspace, nominal errors
        cloud: Points x y z to show, such as workspace --out writes
        host: address; 127.0.0.1: this computer only
        port: port, or the next free one
        no_shadows: Draw no shadows; faster without a graphics card
    """

    simulated: Annotated[Path | None, Parameter(metavar="LOG")] = None
    columns: Annotated[Path | None, Parameter(metavar="MAP.yaml")] = None
    result: Annotated[args.Paths, Parameter(metavar="FILE.json")] = ()
    compute: bool = False
    cloud: Annotated[Path | None, Parameter(metavar="FILE.csv")] = None
    host: Annotated[str, Parameter(metavar="ADDRESS")] = _HERE[0]
    port: Annotated[int, Parameter(validator=args.PORT, converter=args.read_whole)] = 8080
    no_shadows: bool = False


def view(
    robot: args.RobotName,
    log: Path | None = None,
    /,
    *,
    contents: Contents = Contents(),
    seconds: Annotated[args.Positive | None, Parameter(name="--for", metavar="SECONDS")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """The robot in the browser: sliders for its actuated joints, playback of a log, results where they live.

    Args:
        log: A log to play
        seconds: Close after this long
    """
    with show_progress(output.quiet) as step:
        viewer = open_window(robot, log, contents, robot_options, step)
    if contents.host not in _HERE:
        print(f"warning: everybody who reaches {contents.host} can look and move the sliders", file=sys.stderr)
    if not output.quiet:
        screen = sys.stderr if output.json == args.STDOUT else sys.stdout
        print(f"{viewer.robot.name} at {viewer.url}   (Ctrl+C ends it)", file=screen, flush=True)
    viewer.wait(seconds)
    return Outcome(
        result={"url": viewer.url},
        warnings=viewer.warnings,
        inputs=[*robot_options.list_files(robot), log, contents.simulated, *contents.result, contents.cloud],
    )


def open_window(
    robot: str, log: Path | None, contents: Contents, options: args.RobotOptions, step: Callable[[str], None]
):
    """Return the window with all that the arguments name in it; nothing is opened before all of it is read."""
    from tau_dyn.log import read_log
    from tau_dyn.view import Viewer, build_playback, read_cloud, read_result

    if contents.simulated and not log:
        raise InputError("bad_option", "--simulated is the ghost of a log; name the log too")
    step("loading")
    machine = options.load(robot)
    playback = None
    if log is not None:
        ghost = None if contents.simulated is None else read_log(contents.simulated)
        recorded = read_log(log, columns=contents.columns)
        machine = options.hold_silent_joints(machine, robot, [recorded])
        playback = build_playback(recorded, machine, ghost)
    step("reading results")
    shown = [c for path in contents.result for c in read_result(path, machine, compute=contents.compute)]
    shown += [] if contents.cloud is None else [read_cloud(contents.cloud)]
    viewer = Viewer(machine, host=contents.host, port=contents.port, shadows=not contents.no_shadows)
    if playback is not None:
        viewer.play(playback)
    viewer.add(shown)
    return viewer
