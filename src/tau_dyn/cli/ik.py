"""Which actuated positions put the tool at a pose."""

from __future__ import annotations

import argparse

import numpy as np

from tau_dyn.cli.common import Outcome, add_robot, load_robot_from, show_progress
from tau_dyn.cli.kinds import finite
from tau_dyn.cli.pose_tables import add_table_options, build_outcome, read_columns
from tau_dyn.exceptions import InputError

HELP = "inverse kinematics: which actuated positions put the tool at a pose"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument("--position", metavar=("X", "Y", "Z"), nargs=3, type=finite, help="of the tool [m]")
    parser.add_argument(
        "--quaternion", metavar=("X", "Y", "Z", "W"), nargs=4, type=finite, help="of the tool; by default home's"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="all configurations, also outside joint limits; the count is proved in closed form or by elimination, or only found",
    )
    add_table_options(parser, "poses x_tool y_tool z_tool [qx_tool qy_tool qz_tool qw_tool]")


def run(args: argparse.Namespace) -> Outcome:
    """Compute positions."""
    if (args.position is None) == (args.poses is None):
        raise InputError("bad_option", "give --position X Y Z or --poses POSES.csv")
    if args.quaternion is not None and args.position is None:
        raise InputError("bad_option", "--quaternion goes with --position; a table has its own columns qx_tool ..")
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.kinematics import build_inverse_table, place_home_orientation, read_poses
        from tau_dyn.mechanism import convert_from_quaternions

        robot = load_robot_from(args)
        if args.poses is not None:
            poses = read_poses(read_columns(args.poses), robot, str(args.poses))
        elif args.quaternion is not None:
            poses = convert_from_quaternions(np.array([args.position]), np.array([args.quaternion]))
        else:
            poses = place_home_orientation(robot, np.array([args.position]))
        step("solving")
        return build_outcome(build_inverse_table(robot, poses, all_configurations=args.all), args)
