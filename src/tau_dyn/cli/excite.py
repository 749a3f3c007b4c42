"""`tau-dyn excite`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli.arguments import (
    NotNegative,
    NotNegatives,
    Output,
    Positive,
    Positives,
    RobotName,
    RobotOptions,
    Whole,
    build_destination,
)
from tau_dyn.cli.execute import Outcome, show_progress
from tau_dyn.exceptions import InputError

_DESIGN = Group("Design (--method optimal)")
_NOISE = Group("Noise, for the predicted standard errors")
_LIMIT = "one or one a joint"
_Box = tuple[float, float, float, float, float, float]


def excite(
    robot: RobotName,
    /,
    *,
    out: Annotated[Path, build_destination("MOTION.csv", "Write t, q_ref, v_ref, a_ref here", csv=True)],
    duration: Annotated[Positive, Parameter(metavar="S")] = 30.0,
    trials: Annotated[Whole, Parameter(metavar="N")] = 20,
    model: Annotated[str, Parameter(metavar="MODEL")] = "asymmetric",
    method: Literal["optimal", "random"] = "optimal",
    criterion: Annotated[Literal["worst", "d", "condition"] | None, Parameter(group=_DESIGN)] = None,
    fastest: Annotated[Positive | None, Parameter(group=_DESIGN, metavar="HZ")] = None,
    strokes: Annotated[NotNegative | None, Parameter(group=_DESIGN, metavar="SHARE")] = None,
    speed: Annotated[
        Positives | None,
        Parameter(
            group=_DESIGN,
            metavar="V",
            help=f"Highest speed, {_LIMIT} [m/s or rad/s] (default 90 % of the limit, at most 1 m/s or 2 rad/s)",
        ),
    ] = None,
    acceleration: Annotated[
        Positives | None,
        Parameter(
            group=_DESIGN,
            metavar="A",
            help=f"Highest acceleration, {_LIMIT} (default 6 times the highest speed a second)",
        ),
    ] = None,
    box: Annotated[_Box | None, Parameter(group=_DESIGN, metavar="X Y Z X Y Z")] = None,
    condition: Annotated[Positive | None, Parameter(group=_DESIGN, metavar="C")] = None,
    time: Annotated[Positive | None, Parameter(group=_DESIGN, metavar="S")] = None,
    force_noise: Annotated[Positives | None, Parameter(group=_NOISE, metavar="N")] = None,
    encoder_noise: Annotated[NotNegatives | None, Parameter(group=_NOISE, metavar="M")] = None,
    noise_from: Annotated[Path | None, Parameter(group=_NOISE, metavar="LOG")] = None,
    rate: Annotated[Positive, Parameter(group=_NOISE, metavar="HZ")] = 1000.0,
    robot_options: RobotOptions = RobotOptions(),
    output: Output = Output(),
) -> Outcome:
    """An exciting motion within the robot's limits, designed for the most information, with the standard errors it will give.

    Args:
        duration: Length [s]
        trials: Random motions to start or choose from
        model: What shall be identified: rigid, symmetric, asymmetric or a model file
        method: Search for the best motion, or keep the best conditioned of random ones
        criterion: worst: the largest relative standard error (default); d: the volume of the confidence ellipsoid;
            condition: of the regressor
        fastest: Highest frequency of the periodic part (default 2)
        strokes: Share of the time for strokes at constant speeds (default 0.2)
        box: Box [m] that the tool stays in: its lowest and its highest corner
        condition: Largest conditioning of the loops
        time: Longest time for the search (default 90 s)
        force_noise: Standard deviation [N or N m]
        encoder_noise: Standard deviation [m or rad]
        noise_from: Take both from what a model leaves of this log
        rate: Rate of the log to come
    """
    design = {
        "fastest": fastest, "strokes": strokes, "speed": speed, "acceleration": acceleration, "box": box,
        "condition": condition, "time": time, "criterion": criterion,
    }  # fmt: skip
    design = {name: value for name, value in design.items() if value is not None}
    if method == "random" and design:
        raise InputError(
            "bad_option", f"--{next(iter(design))} is not available with --method random; use --method optimal"
        )
    if noise_from is not None and (force_noise or encoder_noise):
        raise InputError(
            "bad_option", "--noise-from excludes --force-noise and --encoder-noise; give one or the others"
        )
    with _show_rounds(output.quiet) as step:
        step("loading")
        from tau_dyn.excitation import Noise, estimate_log_noise
        from tau_dyn.identify import build_model
        from tau_dyn.log import read_log
        from tau_dyn.render import ExcitingMotion

        machine = robot_options.load(robot)
        built, noise = build_model(machine, model), None
        if noise_from is not None:
            noise = estimate_log_noise(built, read_log(noise_from), rate)
        elif force_noise is not None:
            noise = Noise.given(machine, force_noise, encoder_noise or [0.0], rate)
        elif encoder_noise is not None:
            raise InputError("bad_option", "--encoder-noise needs --force-noise as well")
        if method == "random":
            motion, result, said, prediction = _choose_random(built, noise, duration, trials, output.seed, step)
        else:
            motion, result, said, prediction = _design(built, noise, duration, trials, output.seed, rate, design, step)
    condition_number = result["condition_number"]

    def show(console, written: dict[str, str]) -> None:
        console.print(f"{motion.duration:.4g} s, condition number {condition_number:.3g} {said} -> {out}", markup=False)
        for row in () if prediction is None else prediction.rows():
            shown = f"  {row['expression']:44s} {row['value']:10.4g} ± {row['stderr']:.2g} {row['unit']}"
            console.print(shown, markup=False, highlight=False)

    made = {"seed": str(output.seed), "trials": str(trials), "method": method}
    return Outcome(
        result=result | {"out": str(out)},
        warnings=[*machine.warnings, *motion.notes],
        inputs=[*robot_options.list_files(robot), *([noise_from] if noise_from is not None else [])],
        show=show,
        files={out: motion.to_csv},
        found=ExcitingMotion(motion, built, condition_number, prediction, made),
    )


def _choose_random(model, noise, duration: float, trials: int, seed: int, step: Callable[[str], None]):
    """Return the best conditioned of random motions, its result, what is said of it, and the predicted errors."""
    from tau_dyn.excitation import predict
    from tau_dyn.simulate import build_exciting_motion, compute_base_condition

    step("searching")
    motion = build_exciting_motion(model, duration, seed, trials=trials)
    condition = compute_base_condition(model, motion)
    prediction = None if noise is None else predict(model, motion, noise, seed)
    result: dict[str, Any] = {"condition_number": condition, "duration_s": motion.duration, "method": "random"}
    if noise is not None and prediction is not None:
        result |= {"noise": _describe_noise(noise), "predicted": prediction.rows()}
    return motion, result, f"(best of {trials})", prediction


def _design(model, noise, duration: float, trials: int, seed: int, rate: float, given: dict[str, Any], step):
    """Return the designed motion, its result, what is said of it, and the predicted errors."""
    from tau_dyn.excitation import design_motion
    from tau_dyn.simulate import compute_base_condition

    renamed = {"fastest": "fast_hz", "time": "seconds"}
    options = {renamed.get(name, name): value for name, value in given.items()}
    design = design_motion(model, duration, seed, noise=noise, trials=trials, progress=step, rate_hz=rate, **options)
    name, error = design.prediction.worst
    result = {
        "condition_number": compute_base_condition(model, design.motion),
        "duration_s": design.motion.duration,
        "method": "optimal",
        "criterion": design.criterion,
        "criterion_values": list(design.values),
        "finished": design.finished,
        "search_s": design.seconds,
        "evaluations": design.evaluations,
        "noise": _describe_noise(design.noise),
        "predicted": design.prediction.rows(),
        "worst": {"name": name, "relative_stderr": error, "of_random_start": design.before.worst[1]},
    }
    said = f"(the random start: largest relative error {100 * design.before.worst[1]:.3g} %)"
    return design.motion, result, said, design.prediction


def _describe_noise(noise) -> dict[str, Any]:
    return {"force": noise.force, "encoder": noise.encoder, "rate_hz": noise.rate_hz, "source": noise.source}


@contextmanager
def _show_rounds(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show steps as all commands do; where nobody watches the terminal, the search's rounds as lines on stderr."""
    with show_progress(quiet) as step:
        plain = not quiet and not sys.stderr.isatty()

        def tell(text: str) -> None:
            step(text)
            if plain and text.startswith("round"):
                print(text, file=sys.stderr, flush=True)

        yield tell
