"""`tau-dyn excite`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_DESIGN = Group("Design (--method optimal)")
_NOISE = Group("Noise, for the predicted standard errors")


@Parameter(name="*", group=_DESIGN)
@dataclass(frozen=True, kw_only=True)
class DesignOptions:
    """Options of the search for the best motion; with None the design chooses.

    Attributes:
        criterion: worst: the largest relative standard error (default); d: the volume of the confidence ellipsoid;
            condition: of the regressor
        fastest: Highest frequency of the periodic part (default 2)
        strokes: Share of the time for strokes at constant speeds (default 0.2)
        speed: Highest speed, one or one per joint [m/s or rad/s] (default 90 % of the limit, at most 1 m/s or 2 rad/s)
        acceleration: Highest acceleration, one or one per joint (default 6 times the highest speed per second)
        box: Box [m] that the tool stays in: its lowest and its highest corner
        condition: Largest condition number of the loops
        time: Longest time for the search (default 90 s)
    """

    criterion: Literal["worst", "d", "condition"] | None = None
    fastest: Annotated[args.Positive | None, Parameter(metavar="HZ")] = None
    strokes: Annotated[args.NotNegative | None, Parameter(metavar="SHARE")] = None
    speed: Annotated[args.Positives | None, Parameter(metavar="V")] = None
    acceleration: Annotated[args.Positives | None, Parameter(metavar="A")] = None
    box: Annotated[tuple[float, float, float, float, float, float] | None, Parameter(metavar="X Y Z X Y Z")] = None
    condition: Annotated[args.Positive | None, Parameter(metavar="C")] = None
    time: Annotated[args.Positive | None, Parameter(metavar="S")] = None


@Parameter(name="*", group=_NOISE)
@dataclass(frozen=True, kw_only=True)
class NoiseOptions:
    """Expected noise of the future log.

    Attributes:
        force_noise: Standard deviation [N or N m]
        encoder_noise: Standard deviation [m or rad]
        noise_from: Estimate both from the residual of a model on this log
        rate: Rate of the future log
    """

    force_noise: Annotated[args.Positives | None, Parameter(metavar="N")] = None
    encoder_noise: Annotated[args.NotNegatives | None, Parameter(metavar="M")] = None
    noise_from: Annotated[Path | None, Parameter(metavar="LOG")] = None
    rate: Annotated[args.Positive, Parameter(metavar="HZ")] = 1000.0

    def estimate(self, model):
        """Return the noise, or None if it is not given.

        Raises:
            InputError: The encoders' noise is given without the forces'.
        """
        from tau_dyn.excitation import Noise, estimate_log_noise
        from tau_dyn.log import read_log

        if self.noise_from is not None:
            return estimate_log_noise(model, read_log(self.noise_from), self.rate)
        if self.force_noise is not None:
            return Noise.given(model.robot, self.force_noise, self.encoder_noise or [0.0], self.rate)
        if self.encoder_noise is not None:
            raise InputError("bad_option", "--encoder-noise needs --force-noise as well")
        return None


def excite(
    robot: args.RobotName,
    /,
    *,
    out: Annotated[Path, args.build_destination("MOTION.csv", "Write t, q_ref, v_ref, a_ref here", csv=True)],
    duration: Annotated[args.Positive, Parameter(metavar="S")] = 30.0,
    trials: Annotated[args.Whole, Parameter(metavar="N")] = 20,
    model: Annotated[str, Parameter(metavar="MODEL")] = "asymmetric",
    method: Literal["optimal", "random"] = "optimal",
    design: DesignOptions = DesignOptions(),
    noise: NoiseOptions = NoiseOptions(),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """An exciting motion within the robot's limits, with predicted standard errors.

    Args:
        duration: Length [s]
        trials: Random motions to start or choose from
        model: Model to be identified: rigid, symmetric, asymmetric or a model file
        method: Search for the best motion, or select the best conditioned of random ones
    """
    given = {name: value for name, value in asdict(design).items() if value is not None}
    if method == "random" and given:
        raise InputError(
            "bad_option", f"--{next(iter(given))} is not available with --method random; use --method optimal"
        )
    if noise.noise_from is not None and (noise.force_noise or noise.encoder_noise):
        raise InputError(
            "bad_option", "--noise-from excludes --force-noise and --encoder-noise; give one or the others"
        )
    with _show_rounds(output.quiet) as step:
        step("loading")
        from tau_dyn.identify import build_model
        from tau_dyn.render import ExcitingMotion

        machine = robot_options.load(robot)
        built = build_model(machine, model)
        known = noise.estimate(built)
        if method == "random":
            motion, result, said, prediction = _choose_random(built, known, duration, trials, output.seed, step)
            search = ""
        else:
            motion, result, said, prediction, search = _design(
                built, known, duration, trials, output.seed, noise.rate, given, step
            )
    condition_number = result["condition_number"]
    lines = [f"{motion.duration:.4g} s, condition number {condition_number:.3g} {said} -> {out}"]
    lines += [f"search: {search}"] if search else []
    for row in () if prediction is None else prediction.rows():
        lines.append(f"  {row['expression']:44s} {row['value']:10.4g} ± {row['stderr']:.2g} {row['unit']}")
    made = {"seed": str(output.seed), "trials": str(trials), "method": method} | ({"search": search} if search else {})
    return Outcome(
        result=result | {"out": str(out)},
        warnings=[*machine.warnings, *motion.notes],
        inputs=[*robot_options.list_files(robot), noise.noise_from],
        lines=lines,
        files={out: motion.to_csv},
        printed=False,
        found=ExcitingMotion(motion, built, condition_number, prediction, made),
    )


def _choose_random(model, noise, duration: float, trials: int, seed: int, step: Callable[[str], None]):
    """Return the best conditioned of random motions, its result, sentences about it, and the predicted errors."""
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
    """Return the designed motion, its result, sentences about it, the predicted errors, and the course of the search."""
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
    said = f"(largest relative error {100 * error:.3g} %; of the random start {100 * design.before.worst[1]:.3g} %)"
    return design.motion, result, said, design.prediction, design.search


def _describe_noise(noise) -> dict[str, Any]:
    return {"force": noise.force, "encoder": noise.encoder, "rate_hz": noise.rate_hz, "source": noise.source}


@contextmanager
def _show_rounds(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show steps as in all commands; without a terminal, show the iterations of the search as lines on stderr."""
    with show_progress(quiet) as step:
        plain = not quiet and not sys.stderr.isatty()

        def tell(text: str) -> None:
            step(text)
            if plain and text.startswith("round"):
                print(text, file=sys.stderr, flush=True)

        yield tell
