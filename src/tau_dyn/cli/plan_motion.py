"""The fastest motion between two places that the drives can follow, or one with less effort; free or along a path."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    get_robot_file,
    is_model_file,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import finite, not_negative, positive, read_csv_file_name, whole_number
from tau_dyn.cli.pose_tables import read_columns
from tau_dyn.exceptions import InputError

HELP = "the fastest motion within force limits, free or along a path"

_COLUMNS = ("x_tool", "y_tool", "z_tool")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser, or_model="whose friction then counts")
    ends = parser.add_argument_group("where")
    place = ("X", "Y", "Z")
    ends.add_argument(
        "--from", dest="start", metavar=place, nargs=3, type=finite, help="tool position at the start [m]"
    )
    ends.add_argument("--to", dest="end", metavar=place, nargs=3, type=finite, help="tool position at the end [m]")
    for name, dest in (("from", "start_joints"), ("to", "end_joints")):
        text = f"actuated positions instead of --{name} [m or rad]"
        ends.add_argument(f"--{name}-joints", dest=dest, metavar="Q", nargs="+", type=finite, help=text)
    ends.add_argument(
        "--path", metavar="line|POINTS.csv",
        help="line: the tool goes straight; a table with x_tool, y_tool, z_tool: a spline through these points (default: free)",
    )  # fmt: skip
    _add_limits(parser.add_argument_group("limits, one or one a joint"))
    parser.add_argument(
        "--energy-weight", metavar="W", type=not_negative, default=0.0,
        help="minimise T + W times the integral of squared forces [s per N^2 s] (default 0: the shortest time)",
    )  # fmt: skip
    parser.add_argument("--rate", metavar="HZ", type=positive, default=1000.0, help="of the motion (default 1000)")
    parser.add_argument(
        "--nodes", metavar="N", type=whole_number, default=80, help="intervals of linear acceleration (default 80)"
    )
    parser.add_argument(
        "--out", metavar="MOTION.csv", type=read_csv_file_name, required=True, help="write t, q_ref, v_ref, a_ref here"
    )
    add_common(parser)


def _add_limits(group: argparse._ArgumentGroup) -> None:
    for name, unit, default in (
        ("force", "N or N m", "the robot file's"),
        ("speed", "m/s or rad/s", "the robot file's"),
        ("acceleration", "m/s^2 or rad/s^2", "none"),
        ("jerk", "m/s^3 or rad/s^3", "none"),
    ):
        text = f"largest {name} [{unit}] (default {default})"
        group.add_argument(f"--{name}-limit", metavar="L", type=positive, nargs="+", help=text)
    group.add_argument(
        "--margin", metavar="SHARE", type=not_negative, default=0.0,
        help="share of the forces that is kept for the feedback (default 0)",
    )  # fmt: skip
    group.add_argument("--condition", metavar="C", type=positive, help="largest conditioning of the loops")


def run(args: argparse.Namespace) -> Outcome:
    """Plan."""
    start, end, joints = _ends(args)
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.control.motion import MotionLimits, plan_motion

        model = _model(args)
        given = {name: getattr(args, f"{name}_limit") for name in ("force", "speed", "acceleration", "jerk")}
        limits = MotionLimits.of(model, margin=args.margin, condition=args.condition, **given)
        step("optimising")
        plan = plan_motion(
            model, start, end, limits=limits, energy_weight=args.energy_weight, path=_path(args), joints=joints,
            dt=1 / args.rate, nodes=args.nodes,
        )  # fmt: skip

    def show(console) -> None:
        from tau_dyn.render import print_result

        print_result(console, plan, list_written_files(args, motion=args.out))

    return Outcome(
        result=plan.to_dict() | {"out": str(args.out)},
        warnings=[*model.robot.warnings, *plan.warnings],
        inputs=[
            *get_robot_file(args),
            *([Path(args.path)] if args.path not in (None, "line") else []),
        ],
        show=show,
        files={args.out: plan.to_csv},
        report=lambda: _page(plan),
    )


def _ends(args: argparse.Namespace):
    """Return start, end and whether they are actuated positions."""
    tool, joints = (args.start, args.end), (args.start_joints, args.end_joints)
    if None not in tool and joints == (None, None):
        return (*tool, False)
    if None not in joints and tool == (None, None):
        return (*joints, True)
    raise InputError(
        "bad_option", "say where the motion starts and ends: --from X Y Z --to X Y Z, or --from-joints and --to-joints"
    )


def _path(args: argparse.Namespace):
    """Return None, 'line', or the points of a table (n, 3)."""
    from tau_dyn.kinematics import pick_columns

    if args.path in (None, "line"):
        return args.path
    if not Path(args.path).is_file():
        raise InputError(
            "bad_option", f"--path {args.path}: write line, or name a table with the columns {', '.join(_COLUMNS)}"
        )
    table = read_columns(Path(args.path))
    missing = [name for name in _COLUMNS if name not in table]
    if missing:
        raise InputError(
            "missing_column", f"{args.path}: there is no column {missing[0]}; a path has {', '.join(_COLUMNS)} [m]"
        )
    return pick_columns(table, list(_COLUMNS), str(args.path))


def _model(args: argparse.Namespace):
    """Return the model that ROBOT names: a file of ours with its effects, or a rigid robot."""
    from tau_dyn.model import Model

    if not is_model_file(args.robot):
        return Model.of(load_robot_from(args))
    if args.set or args.actuated:
        raise InputError(
            "bad_option", f"{args.robot} is a model file, which carries its own robot; leave --set and --actuated out"
        )
    return Model.load(args.robot)


def _page(plan) -> str:
    from tau_dyn.render import build_page

    return build_page(plan, command_line=format_command_line())
