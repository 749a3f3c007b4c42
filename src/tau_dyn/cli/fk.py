"""Where actuated positions put the tool."""

from __future__ import annotations

import argparse

import numpy as np

from tau_dyn.cli.common import Outcome, add_robot, load_robot_from, show_progress
from tau_dyn.cli.kinds import finite
from tau_dyn.cli.pose_tables import add_table_options, build_outcome, read_columns
from tau_dyn.exceptions import InputError

HELP = "forward kinematics: where actuated positions put the tool"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "--q", metavar="VALUE", nargs="+", type=finite, help="actuated positions [m or rad], in their order"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="every assembly mode found, with the count: proved in closed form or by a certificate, else found from many starts",
    )
    add_table_options(parser, "positions q_<joint>")


def run(args: argparse.Namespace) -> Outcome:
    """Compute poses."""
    if (args.q is None) == (args.poses is None):
        raise InputError("bad_option", "give --q VALUE ... or --poses POSES.csv")
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.kinematics import build_forward_table, read_positions

        robot = load_robot_from(args)
        if args.q is not None and len(args.q) != robot.na:
            named = ", ".join(robot.actuated)
            raise InputError("bad_option", f"--q: one value for each actuated joint ({named}), not {len(args.q)}")
        q = (
            np.array([args.q])
            if args.poses is None
            else read_positions(read_columns(args.poses), robot, str(args.poses))
        )
        step("closing the rods")
        return build_outcome(build_forward_table(robot, q, all_modes=args.all, progress=step), args)
