"""An exciting motion within the robot's limits, designed for the most information, with the standard errors it will give."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    get_robot_file,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import not_negative, positive, read_csv_file_name, whole_number
from tau_dyn.exceptions import InputError

HELP = "an exciting motion within the robot's limits"

_DESIGN_ONLY = ("fastest", "strokes", "speed", "acceleration", "box", "condition", "time", "criterion")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "--out", metavar="MOTION.csv", type=read_csv_file_name, required=True, help="write t, q_ref, v_ref, a_ref here"
    )
    parser.add_argument("--duration", metavar="S", type=positive, default=30.0, help="length (default 30 s)")
    parser.add_argument(
        "--trials",
        metavar="N",
        type=whole_number,
        default=20,
        help="random motions to start or choose from (default 20)",
    )
    parser.add_argument(
        "--model",
        default="asymmetric",
        help="what shall be identified: rigid, symmetric, asymmetric (default) or a model file",
    )
    parser.add_argument(
        "--method", choices=("optimal", "random"), default="optimal",
        help="search for the best motion (default), or keep the best conditioned of random ones",
    )  # fmt: skip
    _add_design(parser.add_argument_group("design (--method optimal)"))
    _add_noise(parser.add_argument_group("noise, for the predicted standard errors"))
    add_common(parser)


def _add_design(design: argparse._ArgumentGroup) -> None:
    design.add_argument(
        "--criterion", choices=("worst", "d", "condition"), help="worst: the largest relative standard error (default); "
        "d: the volume of the confidence ellipsoid; condition: of the regressor"
    )  # fmt: skip
    design.add_argument(
        "--fastest", metavar="HZ", type=positive, help="highest frequency of the periodic part (default 2)"
    )
    design.add_argument(
        "--strokes",
        metavar="SHARE",
        type=not_negative,
        help="share of the time for strokes at constant speeds (default 0.2)",
    )
    design.add_argument(
        "--speed", metavar="V", type=positive, nargs="+",
        help="highest speed, one or one a joint [m/s or rad/s] (default 90 %% of the limit, at most 1 m/s or 2 rad/s)",
    )  # fmt: skip
    design.add_argument(
        "--acceleration", metavar="A", type=positive, nargs="+",
        help="highest acceleration, one or one a joint (default 6 times the highest speed a second)",
    )  # fmt: skip
    design.add_argument(
        "--box",
        metavar="M",
        type=float,
        nargs=6,
        help="box that the tool stays in: X Y Z of its lowest and highest corner",
    )
    design.add_argument("--condition", metavar="C", type=positive, help="largest conditioning of the loops")
    design.add_argument("--time", metavar="S", type=positive, help="longest time for the search (default 90 s)")


def _add_noise(noise: argparse._ArgumentGroup) -> None:
    noise.add_argument("--force-noise", metavar="N", type=positive, nargs="+", help="standard deviation [N or N m]")
    noise.add_argument(
        "--encoder-noise", metavar="M", type=not_negative, nargs="+", help="standard deviation [m or rad]"
    )
    noise.add_argument("--noise-from", metavar="LOG", type=Path, help="take both from what a model leaves of this log")
    noise.add_argument(
        "--rate", metavar="HZ", type=positive, default=1000.0, help="rate of the log to come (default 1000)"
    )


def run(args: argparse.Namespace) -> Outcome:
    """Find an exciting motion."""
    given = [name for name in _DESIGN_ONLY if getattr(args, name) is not None]
    if args.method == "random" and given:
        raise InputError("bad_option", f"--{given[0]} is not available with --method random; use --method optimal")
    if args.noise_from is not None and (args.force_noise or args.encoder_noise):
        raise InputError(
            "bad_option", "--noise-from excludes --force-noise and --encoder-noise; give one or the others"
        )
    with _told(args.quiet) as step:
        step("loading")
        from tau_dyn.identify import build_model

        robot = load_robot_from(args)
        model = build_model(robot, args.model)
        noise = _noise(args, model)
        return _random(args, model, noise, step) if args.method == "random" else _optimal(args, model, noise, step)


def _random(args: argparse.Namespace, model, noise, step: Callable[[str], None]) -> Outcome:
    from tau_dyn.excitation import predict
    from tau_dyn.simulate import build_exciting_motion, compute_base_condition

    step("searching")
    motion = build_exciting_motion(model, args.duration, args.seed, trials=args.trials)
    condition = compute_base_condition(model, motion)
    prediction = None if noise is None else predict(model, motion, noise, args.seed)
    result = {"condition_number": condition, "duration_s": motion.duration, "out": str(args.out), "method": "random"}
    if noise is not None and prediction is not None:
        result |= {"noise": _noise_row(noise), "predicted": prediction.rows()}
    return _outcome(args, model, motion, condition, result, f"(best of {args.trials})", prediction)


def _optimal(args: argparse.Namespace, model, noise, step: Callable[[str], None]) -> Outcome:
    from tau_dyn.excitation import design_motion
    from tau_dyn.simulate import compute_base_condition

    options = {
        "fast_hz": args.fastest, "strokes": args.strokes, "speed": args.speed, "acceleration": args.acceleration,
        "box": args.box, "condition": args.condition, "seconds": args.time, "criterion": args.criterion,
    }  # fmt: skip
    chosen: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    design = design_motion(
        model, args.duration, args.seed, noise=noise, trials=args.trials, progress=step, rate_hz=args.rate, **chosen
    )
    condition = compute_base_condition(model, design.motion)
    name, error = design.prediction.worst
    result = {
        "condition_number": condition,
        "duration_s": design.motion.duration,
        "out": str(args.out),
        "method": "optimal",
        "criterion": design.criterion,
        "criterion_values": list(design.values),
        "finished": design.finished,
        "search_s": design.seconds,
        "evaluations": design.evaluations,
        "noise": _noise_row(design.noise),
        "predicted": design.prediction.rows(),
        "worst": {"name": name, "relative_stderr": error, "of_random_start": design.before.worst[1]},
    }
    said = f"(the random start: largest relative error {100 * design.before.worst[1]:.3g} %)"
    return _outcome(args, model, design.motion, condition, result, said, design.prediction)


def _outcome(args: argparse.Namespace, model, motion, condition: float, result, said: str, prediction) -> Outcome:
    def show(console) -> None:
        console.print(f"{motion.duration:.4g} s, condition number {condition:.3g} {said} -> {args.out}", markup=False)
        for row in () if prediction is None else prediction.rows():
            shown = f"  {row['expression']:44s} {row['value']:10.4g} ± {row['stderr']:.2g} {row['unit']}"
            console.print(shown, markup=False, highlight=False)

    return Outcome(
        result=result,
        warnings=[*model.robot.warnings, *motion.notes],
        inputs=[*get_robot_file(args), *([args.noise_from] if args.noise_from is not None else [])],
        show=show,
        files={args.out: motion.to_csv},
        report=lambda: _page(motion, model, condition, prediction, args),
    )


def _noise(args: argparse.Namespace, model):
    """Return the noise that the arguments name, or None for that of good drives."""
    from tau_dyn.excitation import Noise, estimate_log_noise
    from tau_dyn.log import read_log

    if args.noise_from is not None:
        return estimate_log_noise(model, read_log(args.noise_from), args.rate)
    if args.force_noise is None:
        if args.encoder_noise is not None:
            raise InputError("bad_option", "--encoder-noise needs --force-noise as well")
        return None
    return Noise.given(model.robot, args.force_noise, args.encoder_noise or [0.0], args.rate)


def _noise_row(noise) -> dict[str, Any]:
    return {"force": noise.force, "encoder": noise.encoder, "rate_hz": noise.rate_hz, "source": noise.source}


@contextmanager
def _told(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show steps as all commands do; where nobody watches the terminal, the search's rounds as lines on stderr."""
    with show_progress(quiet) as step:
        plain = not quiet and not sys.stderr.isatty()

        def told(text: str) -> None:
            step(text)
            if plain and text.startswith("round"):
                print(text, file=sys.stderr, flush=True)

        yield told


def _page(motion, model, condition: float, prediction, args: argparse.Namespace) -> str:
    from tau_dyn.render import ExcitingMotion, build_page

    made = {"seed": str(args.seed), "trials": str(args.trials), "method": args.method}
    return build_page(ExcitingMotion(motion, model, condition, prediction, made), command_line=format_command_line())
