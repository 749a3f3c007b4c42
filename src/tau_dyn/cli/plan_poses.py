"""Which poses to measure for a calibration, how accurate it will be, and in which order to drive to them."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    get_robot_file,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import not_negative, positive, positive_whole, read_csv_file_name, read_number_of_poses

HELP = "poses to measure for a calibration, and what they will give"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "--n",
        metavar="N|auto",
        type=read_number_of_poses,
        default="auto",
        help="how many; auto: until more hardly help (default)",
    )
    parser.add_argument(
        "--model",
        metavar="NAME",
        help="what is to be calibrated, as `calibrate --model` names it (default: all dimensions)",
    )
    parser.add_argument(
        "--criterion",
        default="tool",
        choices=("tool", "worst", "determinant", "condition", "smallest", "amplification"),
        help="what makes poses good (default tool: the tool's predicted variance over the workspace)",
    )
    parser.add_argument(
        "--accuracy",
        metavar="M",
        type=positive,
        help="accuracy asked for, rms over the workspace [m]; refuses where it is not met",
    )
    parser.add_argument(
        "--known",
        metavar="FRAME",
        nargs="+",
        action="extend",
        default=[],
        choices=("device", "tool"),
        help="frames that are known",
    )
    parser.add_argument(
        "--weighted", action="store_true", help="the fit will weigh each pose by the device's covariance there"
    )
    _add_device(parser.add_argument_group("what measures (default: everything seen with 0.1 mm and 0.1 mrad)"))
    _add_demands(parser.add_argument_group("where the robot may go"))
    parser.add_argument(
        "--out", metavar="POSES.csv", type=read_csv_file_name, help="write the places in driving order here: pose, q_J"
    )
    parser.add_argument("--rapid", metavar="FILE.mod", type=Path, help="write a RAPID module here")
    parser.add_argument(
        "--resume",
        metavar="FILE.json",
        type=Path,
        help="progress file: written if it does not exist; otherwise nothing is chosen anew and "
        "--out and --rapid get what is left of it",
    )
    add_common(parser)


def _add_device(group: argparse._ArgumentGroup) -> None:
    device = group.add_mutually_exclusive_group()
    device.add_argument("--camera", metavar="FILE.yaml", type=Path, help="camera and pattern")
    device.add_argument("--tracker", metavar="FILE.yaml", type=Path, help="laser tracker and reflector")


def _add_demands(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--obstacles", metavar="FILE.yaml", type=Path, help="obstacles, safety zones, limits of the tool"
    )
    group.add_argument("--no-collisions", action="store_true", help="let the robot pass through itself")
    group.add_argument(
        "--safety",
        metavar="M",
        type=not_negative,
        default=0.05,
        help="from obstacles and the workspace's border [m] (0.05)",
    )
    group.add_argument(
        "--safety-angle", metavar="DEG", type=not_negative, default=5.0, help="from the ball joints' limits (5)"
    )
    group.add_argument(
        "--candidates",
        metavar="N",
        type=positive_whole,
        default=1000,
        help="about how many poses to choose from (1000)",
    )


def run(args: argparse.Namespace) -> Outcome:
    """Plan, or go on with a plan."""
    if args.resume is not None and args.resume.exists():
        return _going_on(args)
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.calibrate.poses import plan_campaign

        robot = load_robot_from(args)
        plan = plan_campaign(
            robot,
            _device(args),
            args.n,
            model=args.model,
            criterion=args.criterion,
            demands=_demands(args),
            safety=_safety(args),
            required=args.accuracy,
            known=args.known,
            weighted=args.weighted,
            candidates=args.candidates,
            seed=args.seed,
            progress=step,
        )
    files = _files(args, plan.csv, plan.rapid)
    if args.resume is not None:
        files[args.resume] = lambda path: plan.progress().save(path)
    given = [p for p in (args.camera, args.tracker, args.obstacles) if p is not None]
    return Outcome(
        result=plan.to_dict(),
        warnings=[*robot.warnings, *plan.warnings],
        inputs=[*get_robot_file(args), *given],
        show=lambda console: _show(console, plan, args),
        files=files,
    )


def _going_on(args: argparse.Namespace) -> Outcome:
    """Hand out what is left of a plan."""
    from tau_dyn.calibrate.poses import PathCheck, format_rapid_module, format_tour_csv, read_progress
    from tau_dyn.kinematics.workspace import build_machine

    robot = load_robot_from(args)
    now = read_progress(args.resume, robot.actuated)
    q, pose = now.q[now.left], now.pose[now.left]
    check = PathCheck(build_machine(robot), _demands(args))
    done = {state: now.state.count(state) for state in ("measured", "missed")}
    left = int((pose >= 0).sum())
    files = _files(
        args,
        lambda: format_tour_csv(q, pose, robot.actuated),
        lambda: format_rapid_module(q, pose, check.poses(q)[0], robot.joint_kinds, actuated=robot.actuated),
    )
    return Outcome(
        result={"resumed": True, **done, "left": left},
        warnings=robot.warnings,
        inputs=[*get_robot_file(args), args.resume],
        show=lambda console: console.print(
            f"{done['measured']} poses measured, {done['missed']} not seen, {left} left"
        ),
        files=files if left else {},
    )


def _files(args: argparse.Namespace, csv, rapid) -> dict:
    files = {args.out: csv()} if args.out else {}
    if args.rapid:
        files[args.rapid] = rapid()
    return files


def _device(args: argparse.Namespace):
    from tau_dyn.calibrate.poses import read_camera, read_tracker

    if args.camera is not None:
        return read_camera(args.camera)
    return read_tracker(args.tracker) if args.tracker is not None else None


def _demands(args: argparse.Namespace):
    from tau_dyn.kinematics import Surroundings, read_surroundings
    from tau_dyn.kinematics.workspace import PoseRequirements

    around = read_surroundings(args.obstacles) if args.obstacles else Surroundings()
    return PoseRequirements(surroundings=around, collisions=not args.no_collisions)


def _safety(args: argparse.Namespace):
    import numpy as np

    from tau_dyn.calibrate.poses import Safety

    return Safety(args.safety, float(np.deg2rad(args.safety_angle)))


def _show(console, plan, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, plan, list_written_files(args, places=args.out, RAPID=args.rapid, progress=args.resume))
