"""The robot in the browser: sliders for its actuated joints, playback of a log, results where they live."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, add_robot, get_robot_file, load_robot_from, show_progress
from tau_dyn.cli.kinds import port, positive
from tau_dyn.exceptions import InputError

HELP = "the robot in the browser, with a log to play and results where they live"
_HERE = ("127.0.0.1", "localhost", "::1")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument("log", metavar="LOG", type=Path, nargs="?", help="a log to play")
    parser.add_argument(
        "--simulated", metavar="LOG", type=Path, help="the same motion simulated, as a ghost (default: its references)"
    )
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="column map of a foreign log")
    parser.add_argument(
        "--result",
        metavar="FILE.json",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        help="results to show: --json of diagnose, workspace, accuracy, calibrate, modes, identify",
    )
    parser.add_argument(
        "--compute", action="store_true", help="work out what a result lacks: points of a workspace, nominal errors"
    )
    parser.add_argument(
        "--cloud", metavar="FILE.csv", type=Path, help="points x y z to show, such as workspace --out writes"
    )
    parser.add_argument("--host", default=_HERE[0], help="address (default 127.0.0.1: this computer only)")
    parser.add_argument("--port", type=port, default=8080, help="port (default 8080, or the next free one)")
    parser.add_argument("--no-shadows", action="store_true", help="draw no shadows; faster without a graphics card")
    parser.add_argument("--for", dest="seconds", metavar="SECONDS", type=positive, help="close after this long")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Show the robot until interrupted."""
    with show_progress(args.quiet) as step:
        viewer = open_window(args, step)
    if args.host not in _HERE:
        print(f"warning: everybody who reaches {args.host} can look and move the sliders", file=sys.stderr)
    if not args.quiet:
        print(f"{viewer.robot.name} at {viewer.url}   (Ctrl+C ends it)", flush=True)
    viewer.wait(args.seconds)
    given = [p for p in (args.log, args.simulated, *args.result, args.cloud) if p is not None]
    return Outcome(result={"url": viewer.url}, warnings=viewer.robot.warnings, inputs=[*get_robot_file(args), *given])


def open_window(args: argparse.Namespace, step: Callable[[str], None]):
    """Return the window with all that the arguments name in it; nothing is opened before all of it is read."""
    from tau_dyn.view import Viewer, read_cloud, read_result

    if args.simulated and not args.log:
        raise InputError("bad_option", "--simulated is the ghost of a log; name the log too")
    step("loading")
    robot = load_robot_from(args)
    playback = _playback(args, robot)
    step("reading results")
    contents = [c for path in args.result for c in read_result(path, robot, compute=args.compute)]
    contents += [] if args.cloud is None else [read_cloud(args.cloud)]
    viewer = Viewer(robot, host=args.host, port=args.port, shadows=not args.no_shadows)
    if playback is not None:
        viewer.play(playback)
    viewer.add(contents)
    return viewer


def _playback(args: argparse.Namespace, robot):
    from tau_dyn.log import read_log
    from tau_dyn.view import build_playback

    if args.log is None:
        return None
    simulated = None if args.simulated is None else read_log(args.simulated)
    return build_playback(read_log(args.log, columns=args.columns), robot, simulated)
