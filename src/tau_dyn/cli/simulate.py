"""A log from the model, its controller and its sensors; `check`, `identify` and the rest read it like a recorded one."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli import vibration
from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    get_robot_file,
    is_model_file,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import finite, not_negative, positive, read_csv_file_name
from tau_dyn.exceptions import InputError

HELP = "a log from the model, its controller and sensors"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser, or_model="which carries its robot, its effects and their values")
    parser.add_argument(
        "--motion",
        metavar="M",
        default="fourier",
        help="fourier (default), slow, strokes, multisine, prbs, or a CSV with t and q_ref_JOINT",
    )
    parser.add_argument(
        "--duration", metavar="S", type=positive, default=60.0, help="length of a named motion (default 60 s)"
    )
    parser.add_argument("--out", metavar="LOG.csv", type=read_csv_file_name, required=True, help="write the log here")
    truth = parser.add_mutually_exclusive_group()
    truth.add_argument("--effects", metavar="E.yaml", type=Path, help="effects and parameter values of the true robot")
    truth.add_argument(
        "--model", metavar="FILE", type=Path, help="put the effects and values of this model file on ROBOT"
    )
    sensors = parser.add_argument_group("controller and sensors")
    sensors.add_argument("--rate", metavar="HZ", type=positive, help="control rate (default 1000)")
    sensors.add_argument(
        "--log-rate", metavar="HZ", type=positive, help="log rate, the control rate over a whole number"
    )
    sensors.add_argument(
        "--force-noise", metavar="N", type=not_negative, default=5.0, help="standard deviation [N or N m] (default 5)"
    )
    sensors.add_argument(
        "--force-colour", metavar="PHI", type=finite, default=0.0, help="AR(1) coefficient of the force noise"
    )
    sensors.add_argument(
        "--encoder-noise", metavar="M", type=not_negative, default=5e-6, help="[m or rad] (default 5e-6)"
    )
    sensors.add_argument(
        "--encoder-resolution", metavar="M", type=not_negative, default=0.0, help="[m or rad] (default none)"
    )
    sensors.add_argument("--tool-noise", metavar="M", type=not_negative, default=0.0, help="tool position noise [m]")
    vibration.add_options(parser)
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Simulate."""
    if args.vibration:
        return vibration.run(args)
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.simulate import Sensors, Trajectory, build_named_motion, simulate

        model = _model(args)
        if Path(args.motion).suffix:
            motion = Trajectory.from_csv(args.motion, model.robot.actuated)
        else:
            motion = build_named_motion(args.motion, model, args.duration, args.seed)
        sensors = Sensors(
            encoder_noise=args.encoder_noise,
            encoder_resolution=args.encoder_resolution,
            force_noise=args.force_noise,
            force_ar=(args.force_colour,) if args.force_colour else (),
            tool_noise=args.tool_noise,
            log_rate_hz=args.log_rate,
        )
        log = simulate(
            model,
            motion,
            sensors=sensors,
            seed=args.seed,
            rate_hz=args.rate or 1000.0,
            name=args.out.name,
            progress=lambda share: step(f"simulating {100 * share:.0f} %"),
        )
    given = [args.effects, args.model, Path(args.motion)]
    return Outcome(
        result={"n_samples": log.n_samples, "duration_s": log.duration, "rate_hz": log.rate_hz, "out": str(args.out)},
        warnings=[*model.robot.warnings, *log.warnings],
        inputs=[*get_robot_file(args), *(p for p in given if p is not None and p.is_file())],
        show=lambda console: console.print(
            f"{log.duration:.4g} s of {model.robot.name} at {log.rate_hz:g} Hz -> {args.out}", markup=False
        ),
        files={args.out: log.to_csv},
        report=lambda: _page(log, model, sensors, args),
    )


def _model(args: argparse.Namespace):
    """Return what is simulated: a model file's robot as it is, or ROBOT with hidden effects, a model's values, or nominal."""
    from tau_dyn.identify import build_model
    from tau_dyn.model import Model
    from tau_dyn.simulate import read_effects_file

    if is_model_file(args.robot):
        options = {"--set": args.set, "--actuated": args.actuated, "--effects": args.effects, "--model": args.model}
        given = [name for name, value in options.items() if value]
        if given:
            raise InputError(
                "bad_option",
                f"{args.robot} is a model file, which carries its own robot, effects and values; leave {given[0]} out, or "
                f"name the robot and give the file with --model",
            )
        return Model.load(args.robot)
    robot = load_robot_from(args)
    if args.effects:
        return read_effects_file(args.effects, robot)
    return build_model(robot, args.model) if args.model else Model.of(robot)


def _page(log, model, sensors, args: argparse.Namespace) -> str:
    from tau_dyn.render import SimulatedLog, build_page

    made = {"motion": args.motion, "seed": str(args.seed)}
    return build_page(SimulatedLog(log, model, sensors, made), command_line=format_command_line())
