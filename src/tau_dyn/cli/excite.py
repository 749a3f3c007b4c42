"""An exciting motion within the robot's limits: the best of many random Fourier motions by condition number."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    command_line,
    csv_file,
    load_robot_from,
    positive,
    progress,
    robot_file,
    whole_number,
)

HELP = "an exciting motion within the robot's limits"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "--out", metavar="MOTION.csv", type=csv_file, required=True, help="write t, q_ref, v_ref, a_ref here"
    )
    parser.add_argument("--duration", metavar="S", type=positive, default=30.0, help="length (default 30 s)")
    parser.add_argument(
        "--trials", metavar="N", type=whole_number, default=20, help="random motions to choose from (default 20)"
    )
    parser.add_argument(
        "--model", default="asymmetric", help="what shall be identified: rigid, symmetric, asymmetric or a file"
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Find an exciting motion."""
    with progress(args.quiet) as step:
        step("searching")
        from tau_dyn.identify import build_model
        from tau_dyn.simulate import base_condition, exciting_motion

        robot = load_robot_from(args)
        model = build_model(robot, args.model)
        motion = exciting_motion(model, args.duration, args.seed, trials=args.trials)
        condition = base_condition(model, motion)
    return Outcome(
        result={"condition_number": condition, "duration_s": motion.duration, "out": str(args.out)},
        warnings=[*robot.warnings, *motion.notes],
        inputs=robot_file(args),
        show=lambda console: console.print(
            f"{motion.duration:.4g} s, condition number {condition:.3g} (best of {args.trials}) -> {args.out}",
            markup=False,
        ),
        files={args.out: motion.to_csv},
        report=lambda: _page(motion, model, condition, args),
    )


def _page(motion, model, condition: float, args: argparse.Namespace) -> str:
    from tau_dyn.report import excitation_page

    made = {"seed": str(args.seed), "trials": str(args.trials)}
    return excitation_page(motion, model, condition, command_line=command_line(), **made)
