"""The robot in the browser: sliders for its actuated joints, playback of a log, findings and clouds where they live."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, add_robot, load_robot_from, positive, progress, robot_file

HELP = "the robot in the browser, with a log to play"


def _port(text: str) -> int:
    value = int(text)
    if not 0 < value < 65536:
        raise ValueError
    return value


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument("log", metavar="LOG", type=Path, nargs="?", help="a log to play")
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="column map of a foreign log")
    parser.add_argument("--result", metavar="FILE.json", type=Path, help="result of diagnose, whose findings are shown")
    parser.add_argument("--cloud", metavar="FILE.csv", type=Path, help="points x y z to show, such as a workspace")
    parser.add_argument("--host", default="127.0.0.1", help="address (default 127.0.0.1: this computer only)")
    parser.add_argument("--port", type=_port, default=8080, help="port (default 8080, or the next free one)")
    parser.add_argument("--for", dest="seconds", metavar="SECONDS", type=positive, help="close after this long")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Show the robot until interrupted."""
    with progress(args.quiet) as step:
        step("loading")
        from tau_dyn.log import read_log
        from tau_dyn.view import Viewer
        from tau_dyn.view.overlay import cloud_in, findings_in, playback_of

        robot = load_robot_from(args)
        playback = None if args.log is None else playback_of(read_log(args.log, columns=args.columns), robot)
        findings = [] if args.result is None else findings_in(args.result)
        points = None if args.cloud is None else cloud_in(args.cloud)
        viewer = Viewer(robot, host=args.host, port=args.port)
    if playback is not None:
        viewer.play(playback)
    viewer.name(findings)
    if points is not None:
        viewer.cloud(*points)
    if args.host not in ("127.0.0.1", "localhost", "::1"):
        print(f"warning: everybody who reaches {args.host} can look and move the sliders", file=sys.stderr)
    if not args.quiet:
        print(f"{robot.name} at {viewer.url}   (Ctrl+C ends it)", flush=True)
    viewer.wait(args.seconds)
    given = [p for p in (args.log, args.result, args.cloud) if p is not None]
    return Outcome(result={"url": viewer.url}, warnings=robot.warnings, inputs=[*robot_file(args), *given])
