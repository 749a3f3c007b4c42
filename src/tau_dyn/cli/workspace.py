"""Where a robot's tool can be, why not elsewhere, and how stiff, fast and far from singular it is there."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    get_robot_file,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import not_negative, positive, positive_large, read_csv_file_name
from tau_dyn.exceptions import InputError

HELP = "where the tool can be, and how well it works there"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    look = parser.add_argument_group("what is looked at")
    look.add_argument(
        "--resolution", metavar="M", type=positive, help="finest grid [m]; default a 60th of the workspace"
    )
    look.add_argument(
        "--orientation", metavar=("ROLL", "PITCH", "YAW"), nargs=3, type=float, help="turn of the tool from home [deg]"
    )
    look.add_argument(
        "--section",
        metavar="AXIS=M",
        action="append",
        default=[],
        help="plane to judge and draw; default: through home",
    )
    look.add_argument(
        "--map",
        metavar="NAME",
        nargs="+",
        action="extend",
        default=[],
        help="condition, manipulability, singularity, stiffness, speed, force: what sections and --out hold (default: all)",
    )
    look.add_argument(
        "--tilt", metavar=("X", "Y", "Z"), nargs=3, type=float, help="place whose tilt is asked; default home"
    )
    demand = parser.add_argument_group("what a pose must satisfy")
    demand.add_argument(
        "--obstacles", metavar="FILE.yaml", type=Path, help="obstacles, safety zones, limits of the tool"
    )
    demand.add_argument(
        "--tool-limit", metavar="AXIS=LO:HI", action="append", default=[], help="limits of the tool [m]"
    )
    demand.add_argument(
        "--ball-angle", metavar="DEG", type=positive, help="of all ball joints; default the file's, else 45"
    )
    demand.add_argument(
        "--clearance", metavar="M", type=not_negative, default=0.0, help="between the robot's own parts"
    )
    demand.add_argument("--no-collisions", action="store_true", help="let the robot pass through itself")
    demand.add_argument(
        "--condition", metavar="N", type=positive, default=1000.0, help="largest condition number (1000)"
    )
    demand.add_argument(
        "--border", metavar="M", type=not_negative, default=0.0, help="distance to keep from the border"
    )
    spring = parser.add_argument_group("what gives way")
    spring.add_argument("--rod-stiffness", metavar="N/M", type=positive_large, help="of each rod with its joints")
    spring.add_argument(
        "--actuator-stiffness",
        metavar="[JOINT=]VALUE",
        nargs="+",
        action="extend",
        default=[],
        help="N/m or N m/rad; default rigid",
    )
    parser.add_argument(
        "--out", metavar="POINTS.csv", type=read_csv_file_name, help="write the judged points with their reasons here"
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Find the workspace."""
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.kinematics.workspace import study_workspace

        robot = load_robot_from(args)
        found = study_workspace(
            robot,
            demands=_demands(args),
            resolution=args.resolution,
            turn_deg=args.orientation,
            sections=args.section,
            maps=args.map,
            tilt_at=args.tilt,
            rod_stiffness=args.rod_stiffness,
            actuator_stiffness=_stiffnesses(args.actuator_stiffness),
            seed=args.seed,
            progress=step,
        )
    return Outcome(
        result=found.to_dict(),
        warnings=[*robot.warnings, *found.warnings],
        inputs=[*get_robot_file(args), *([args.obstacles] if args.obstacles else [])],
        show=lambda console: _show(console, found, args),
        files={args.out: lambda path: _save(path, found)} if args.out else {},
        report=lambda: _page(found),
    )


def _demands(args: argparse.Namespace):
    import numpy as np

    from tau_dyn.kinematics import Surroundings, add_limits, read_surroundings
    from tau_dyn.kinematics.workspace import PoseRequirements

    around = read_surroundings(args.obstacles) if args.obstacles else Surroundings()
    return PoseRequirements(
        ball_angle=None if args.ball_angle is None else float(np.deg2rad(args.ball_angle)),
        surroundings=add_limits(around, args.tool_limit),
        collisions=not args.no_collisions,
        clearance=args.clearance,
        condition=args.condition,
        border=args.border,
    )


def _stiffnesses(given: list[str]) -> dict[str, float]:
    found = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            found[name] = positive_large(number)
        except argparse.ArgumentTypeError as fault:
            raise InputError(
                "bad_option", f"--actuator-stiffness {text}: write a number above zero, or JOINT=number"
            ) from fault
    return found


def _save(path: Path, found) -> None:
    from tau_dyn.kinematics.workspace import build_points_table

    build_points_table(found).to_csv(path, index=False, float_format="%.9g")


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, found, list_written_files(args, points=args.out))


def _page(found) -> str:
    from tau_dyn.render import build_page

    return build_page(found, command_line=format_command_line())
