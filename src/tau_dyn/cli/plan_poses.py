"""`tau-dyn plan-poses`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter, Token, validators

from tau_dyn.cli import arguments as args
from tau_dyn.cli.calibrate import Frames
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress

_DEVICE = Group(
    "What measures (default: everything seen with 0.1 mm and 0.1 mrad)", validator=validators.MutuallyExclusive()
)
_DEMANDS = Group("Where the robot may go")
Count = int | Literal["auto"]


def _read_count(_: Any, tokens: Sequence[Token]) -> Count:
    """Read a number of poses, or auto.

    Raises:
        ValueError: It is neither.
    """
    text = tokens[0].value
    try:
        value = "auto" if text == "auto" else int(text)
        args.POSITIVE_WHOLE(None, value)
    except ValueError:
        raise ValueError(f"write {args.POSITIVE_WHOLE.words}, or auto") from None
    return value


def plan_poses(
    robot: args.RobotName,
    /,
    *,
    n: Annotated[Count, Parameter(converter=_read_count, n_tokens=1, metavar="N|auto")] = "auto",
    model: Annotated[str | None, Parameter(metavar="NAME")] = None,
    criterion: Literal["tool", "worst", "determinant", "condition", "smallest", "amplification"] = "tool",
    accuracy: Annotated[args.Positive | None, Parameter(metavar="M")] = None,
    known: Frames = (),
    weighted: bool = False,
    camera: Annotated[Path | None, Parameter(group=_DEVICE, metavar="FILE.yaml")] = None,
    tracker: Annotated[Path | None, Parameter(group=_DEVICE, metavar="FILE.yaml")] = None,
    obstacles: Annotated[Path | None, Parameter(group=_DEMANDS, metavar="FILE.yaml")] = None,
    no_collisions: Annotated[bool, Parameter(group=_DEMANDS)] = False,
    safety: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="M")] = 0.05,
    safety_angle: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="DEG")] = 5.0,
    candidates: Annotated[int, Parameter(group=_DEMANDS, metavar="N", validator=args.POSITIVE_WHOLE)] = 1000,
    out: Annotated[
        Path | None, args.build_destination("POSES.csv", "Write the places in driving order here: pose, q_J", csv=True)
    ] = None,
    rapid: Annotated[Path | None, Parameter(metavar="FILE.mod")] = None,
    resume: Annotated[Path | None, Parameter(metavar="FILE.json")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Which poses to measure for a calibration, how accurate it will be, and in which order to drive to them.

    Args:
        n: How many; auto: until more hardly help
        model: What is to be calibrated, as `calibrate --model` names it (default: all dimensions)
        criterion: What makes poses good (tool: the tool's predicted variance over the workspace)
        accuracy: Accuracy asked for, rms over the workspace [m]; refuses where it is not met
        known: Frames that are known
        weighted: The fit will weigh each pose by the device's covariance there
        camera: Camera and pattern
        tracker: Laser tracker and reflector
        obstacles: obstacles, safety zones, limits of the tool
        no_collisions: Let the robot pass through itself
        safety: From obstacles and the workspace's border [m]
        safety_angle: From the ball joints' limits
        candidates: About how many poses to choose from
        rapid: Write a RAPID module here
        resume: Progress file: written if it does not exist; otherwise nothing is chosen anew and --out and --rapid get what
            is left of it
    """
    demands = _build_demands(obstacles, no_collisions)
    if resume is not None and resume.exists():
        return _go_on(robot, robot_options, resume, demands, out, rapid)
    with show_progress(output.quiet) as step:
        step("loading")
        import numpy as np

        from tau_dyn.calibrate.poses import Safety, plan_campaign, read_camera, read_tracker

        machine = robot_options.load(robot)
        device = read_camera(camera) if camera is not None else read_tracker(tracker) if tracker is not None else None
        plan = plan_campaign(
            machine,
            device,
            n,
            model=model,
            criterion=criterion,
            demands=demands,
            safety=Safety(safety, float(np.deg2rad(safety_angle))),
            required=accuracy,
            known=list(known),
            weighted=weighted,
            candidates=candidates,
            seed=output.seed,
            progress=step,
        )
    files = _build_files(out, plan.csv, rapid, plan.rapid)
    if resume is not None:
        files[resume] = lambda path: plan.progress().save(path)

    return Outcome(
        result=plan.to_dict(),
        warnings=[*machine.warnings, *plan.warnings],
        inputs=[*robot_options.list_files(robot), camera, tracker, obstacles],
        found=plan,
        files=files,
        named={"places": out, "RAPID": rapid, "progress": resume},
    )


def _go_on(
    robot: str, options: args.RobotOptions, resume: Path, demands, out: Path | None, rapid: Path | None
) -> Outcome:
    """Hand out what is left of a plan."""
    from tau_dyn.calibrate.poses import PathCheck, format_rapid_module, format_tour_csv, read_progress
    from tau_dyn.kinematics.workspace import build_machine

    machine = options.load(robot)
    now = read_progress(resume, machine.actuated)
    q, pose = now.q[now.left], now.pose[now.left]
    check = PathCheck(build_machine(machine), demands)
    done = {state: now.state.count(state) for state in ("measured", "missed")}
    left = int((pose >= 0).sum())
    files = _build_files(
        out,
        lambda: format_tour_csv(q, pose, machine.actuated),
        rapid,
        lambda: format_rapid_module(q, pose, check.poses(q)[0], machine.joint_kinds, actuated=machine.actuated),
    )
    said = f"{done['measured']} poses measured, {done['missed']} not seen, {left} left"
    return Outcome(
        result={"resumed": True, **done, "left": left},
        warnings=machine.warnings,
        inputs=[*options.list_files(robot), resume],
        lines=[said],
        files=files if left else {},
    )


def _build_files(out: Path | None, csv, rapid: Path | None, module) -> dict[Path, Any]:
    return {**({out: csv()} if out else {}), **({rapid: module()} if rapid else {})}


def _build_demands(obstacles: Path | None, no_collisions: bool):
    from tau_dyn.kinematics import Surroundings, read_surroundings
    from tau_dyn.kinematics.workspace import PoseRequirements

    around = read_surroundings(obstacles) if obstacles else Surroundings()
    return PoseRequirements(surroundings=around, collisions=not no_collisions)
