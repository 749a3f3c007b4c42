"""From measured poses to a geometry with uncertainty: the model they bear, what each step gained, what no pose can tell."""

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
from tau_dyn.cli.kinds import read_csv_file_name
from tau_dyn.cli.pose_tables import read_columns
from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256

HELP = "geometry with uncertainty from measured poses"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "poses",
        metavar="POSES.csv",
        type=Path,
        help="q_J of every actuated joint and x_tool y_tool z_tool [qx_tool ..] in the measuring device's frame",
    )
    parser.add_argument(
        "--holdout",
        metavar="POSES.csv",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        help="poses used for nothing but the final errors (without any, a quarter of many poses, or cross-validation)",
    )
    parser.add_argument(
        "--columns", metavar="MAP.yaml", type=Path, help="names, units and couplings of foreign columns, as of logs"
    )
    parser.add_argument(
        "--model",
        default="auto",
        metavar="NAME",
        help="auto (default); frames, ideal, nonparallel, complete or paths, as the robot offers them; with "
        "+periodic, +piecewise, +compliant, +backlash, +gravity, +eccentric, +coupling:j3/j2 (a share) or coupling:j3=-j2 (all), "
        "each perhaps with joints: nonparallel+periodic:cart2",
    )
    parser.add_argument(
        "--residual", default="forward", choices=("forward", "closure", "inverse"), help="residual to minimise"
    )
    parser.add_argument(
        "--robust",
        default="none",
        choices=("none", "huber", "biweight"),
        help="weights (gross outliers are left out in any case)",
    )
    parser.add_argument(
        "--known",
        metavar="FRAME",
        nargs="+",
        action="extend",
        default=[],
        choices=("device", "tool"),
        help="frames that are known: the device measures in the robot's base frame, the target is the tool frame",
    )
    parser.add_argument(
        "--fix", metavar="NAME", nargs="+", action="extend", default=[], help="parameters that stay nominal"
    )
    parser.add_argument(
        "--free", metavar="NAME", nargs="+", action="extend", default=[], help="parameters freed on top of the model's"
    )
    parser.add_argument(
        "--accuracy",
        metavar="SIGMA",
        nargs="+",
        type=float,
        default=[],
        help="standard error of a measured coordinate [m], and perhaps of an orientation [rad]; held-out errors are judged by it "
        "(default: columns x_tool_stderr .., or repeated poses)",
    )
    parser.add_argument(
        "--prior",
        metavar="SIGMA",
        nargs="+",
        type=float,
        default=[],
        help="how exactly the robot is built to its file: standard deviation of lengths [m], and perhaps of angles [rad] "
        "(default 0.01 0.01)",
    )
    _add_written_files(parser)
    add_common(parser)


def _add_written_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--correct",
        metavar="Q.csv",
        type=Path,
        help="joint positions q_J that a controller computed with the robot file; needs --corrected",
    )
    parser.add_argument(
        "--corrected",
        metavar="Q.csv",
        type=read_csv_file_name,
        help="write the positions at which the calibrated robot is where --correct meant it to be",
    )
    parser.add_argument("--out", metavar="MODEL.yaml", type=Path, help="write the calibrated robot here")


def run(args: argparse.Namespace) -> Outcome:
    """Calibrate."""
    if (args.correct is None) != (args.corrected is None):
        raise InputError(
            "bad_option", "--correct Q.csv and --corrected Q.csv go together: positions to read and to write"
        )
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.calibrate import calibrate, read_poses
        from tau_dyn.kinematics import read_positions
        from tau_dyn.robot import read_annotations

        robot = load_robot_from(args)
        wanted = None if args.correct is None else read_positions(read_columns(args.correct), robot, str(args.correct))
        known = {"columns": args.columns, "mimics": read_annotations(robot.urdf, robot.source).mimics}
        poses = read_poses(args.poses, robot.actuated, **known)
        held, hashes, warnings = _held_out(args, robot, known)
        found = calibrate(
            robot,
            poses,
            held,
            args.model,
            fix=args.fix,
            free=args.free,
            residual=args.residual,
            robust=args.robust,
            device="device" not in args.known,
            tool="tool" not in args.known,
            accuracy=tuple(args.accuracy),
            prior=tuple(args.prior),
            seed=args.seed,
            progress=step,
        )
    read = [(str(args.poses), poses.sha256), *hashes]
    read += [(str(args.correct), compute_sha256(args.correct))] if args.correct else []
    files: dict = {args.out: lambda path: _save(path, found)} if args.out else {}
    more: list[str] = []
    if wanted is not None:
        files[args.corrected], more = _correct(found, wanted)
    return Outcome(
        result=found.to_dict(),
        warnings=[*robot.warnings, *warnings, *found.warnings, *more],
        inputs=[*get_robot_file(args), *read],
        show=lambda console: _show(console, found, args),
        files=files,
        report=lambda: _page(found, read),
    )


def _held_out(args: argparse.Namespace, robot, known: dict):
    from tau_dyn.calibrate import join_pose_sets, read_poses

    same = [path for path in args.holdout if path.resolve() == args.poses.resolve()]
    said = [f"{path} is both fitted and held out; it counts as fitted only" for path in same]
    sets = [(path, read_poses(path, robot.actuated, **known)) for path in args.holdout if path not in same]
    if not sets:
        return None, [], said
    return join_pose_sets([s for _, s in sets]), [(str(path), s.sha256) for path, s in sets], said


def _correct(found, wanted) -> tuple[str, list[str]]:
    """Return corrected positions as a CSV's text, and a warning where some have none."""
    import numpy as np
    import pandas as pd

    from tau_dyn.calibrate import build_compensation

    robot = found.robot
    made = build_compensation(robot, found.fit.geometry, found.fit.theta)(wanted)
    table = pd.DataFrame(made.q, columns=[f"q_{joint}" for joint in robot.actuated]).assign(reason=made.reason)
    lost = np.flatnonzero(~made.ok)
    said = [f"{len(lost)} of {len(wanted)} positions cannot be corrected; row {lost[0] + 1}: {made.reason[lost[0]]}"]
    return table.to_csv(index=False, float_format="%.12g"), said if len(lost) else []


def _save(path: Path, found) -> None:
    from tau_dyn.calibrate import save_calibration

    save_calibration(path, found)


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, found, list_written_files(args, model=args.out))


def _page(found, read: list[tuple[str, str]]) -> str:
    from tau_dyn.render import build_page

    return build_page(found, poses=read, command_line=format_command_line())
