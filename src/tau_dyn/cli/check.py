"""Check whether a log is usable: sampling, gaps, quantisation, saturation, synchronisation, excitation; problems and fixes."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot_options,
    format_command_line,
    get_robot_file,
    load_robot_from,
    show_progress,
)
from tau_dyn.message_codes import UNCODED, get_code

HELP = "check whether a log is usable: problems and fixes"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("log", metavar="LOG", help="CSV, Parquet, MCAP, a ROS bag or .mat")
    parser.add_argument("robot", metavar="ROBOT", nargs="?", help="the robot it is of; tells units and limits")
    add_robot_options(parser)
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="how to read foreign column names and units")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Check a log."""
    with show_progress(args.quiet) as step:
        step("reading")
        from tau_dyn.log import check_log, read_log
        from tau_dyn.report import check_page, print_check

        robot = load_robot_from(args) if args.robot else None
        log = read_log(args.log, args.columns)
        checked = check_log(log, robot)
        if robot is not None:
            from tau_dyn.identify import check_against_robot

            step("holding the log against the robot file")
            checked = checked.with_faults(check_against_robot(robot, [log]))
    return Outcome(
        result=checked.to_dict(),
        warnings=[*log.warnings, *(w for w in checked.warnings if get_code(w) != UNCODED)],
        inputs=[
            (args.log, log.sha256),
            *([args.columns] if args.columns else []),
            *(get_robot_file(args) if args.robot else []),
        ],
        show=lambda console: print_check(console, log, checked),
        report=lambda: check_page(log, checked, robot=robot, command_line=format_command_line()),
    )
