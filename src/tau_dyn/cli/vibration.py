"""`simulate --vibration`: a vibration log of a robot file with springs, instead of a motion."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import Outcome, get_robot_file, load_robot_from, show_progress
from tau_dyn.cli.kinds import not_negative, positive
from tau_dyn.exceptions import InputError

KINDS = ("prbs", "push-x", "push-y", "push-z", "push-xyz")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of vibration logs."""
    group = parser.add_argument_group(
        "vibration (robot files with springs, such as gantry_tau --set arms=complete --set flexible=true)"
    )
    group.add_argument(
        "--vibration",
        choices=KINDS,
        help="instead of a motion, near home: prbs, binary references at 250 Hz; or pushes on the tool at 1 kHz, -xyz in turn",
    )
    group.add_argument(
        "--amplitude",
        metavar="A",
        type=positive,
        help="of the references [m or rad] (default 1e-3), of a push [N s] (2)",
    )
    group.add_argument(
        "--frame", metavar="NAME", default="tool", help="frame or link whose position is logged (default tool)"
    )
    group.add_argument("--push-at", metavar="NAME", help="frame or link that is pushed (default that of --frame)")
    group.add_argument(
        "--drive-lag",
        metavar="S",
        type=positive,
        nargs="+",
        help="time constant of the drives, one or one a joint [s] (default: they follow at once)",
    )
    group.add_argument("--drive-delay", metavar="S", type=not_negative, default=0.0, help="delay of the drives [s]")
    group.add_argument(
        "--acceleration-noise", metavar="A", type=not_negative, default=0.07, help="[m/s^2] (default 0.07)"
    )


def run(args: argparse.Namespace) -> Outcome:
    """Simulate a vibration test."""
    for option, given in (("--effects", args.effects), ("--model", args.model), ("--log-rate", args.log_rate)):
        if given:
            raise InputError("bad_option", f"{option} does not go with --vibration")
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.mechanism import FlexibleModel

        robot = load_robot_from(args)
        near = FlexibleModel(robot).at(tool=args.frame, pushed=args.push_at)
        step("simulating")
        log = _log(near, args)
    frequencies = near.natural_frequencies()
    return Outcome(
        result={
            "n_samples": log.n_samples,
            "duration_s": log.duration,
            "rate_hz": log.rate_hz,
            "out": str(args.out),
            "natural_frequencies_hz": frequencies,
        },
        warnings=[*robot.warnings, *log.warnings],
        inputs=get_robot_file(args),
        show=lambda console: console.print(
            f"{log.duration:.4g} s of {robot.name} near home at {log.rate_hz:g} Hz, lowest resonances "
            f"{', '.join(f'{f:.4g}' for f in frequencies[:4])} Hz -> {args.out}",
            markup=False,
        ),
        files={args.out: log.to_csv},
    )


def _log(near, args: argparse.Namespace):
    from tau_dyn.simulate import VibrationSensors, push_log, simulate_binary_log

    sensors = VibrationSensors(args.encoder_noise, args.tool_noise, args.acceleration_noise)
    shared = {"duration": args.duration, "drives": _drives(near, args), "sensors": sensors, "seed": args.seed}
    if args.vibration == "prbs":
        rate = 250.0 if args.rate is None else args.rate
        return simulate_binary_log(near, rate_hz=rate, amplitude=args.amplitude or 1e-3, name=args.out.name, **shared)
    rate = 1000.0 if args.rate is None else args.rate
    directions = args.vibration.removeprefix("push-")
    shared["repeat"] = max(len(directions), round(args.duration / 5))
    return push_log(near, directions, rate_hz=rate, impulse=args.amplitude or 2.0, name=args.out.name, **shared)


def _drives(near, args: argparse.Namespace):
    from tau_dyn.mechanism import PositionDrives

    if not args.drive_lag:
        if args.drive_delay:
            raise InputError("bad_option", "--drive-delay needs --drive-lag")
        return None
    lags = args.drive_lag * near.na if len(args.drive_lag) == 1 else args.drive_lag
    return PositionDrives(tuple(lags), args.drive_delay)
