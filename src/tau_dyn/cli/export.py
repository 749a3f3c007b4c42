"""A robot or its identified model in another program's language: URDF, MJCF, FMU, C kinematics, controller references, RAPID."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tau_dyn.cli.common import Outcome, add_common, add_robot_options, is_model_file, load_robot_from, show_progress
from tau_dyn.cli.kinds import positive
from tau_dyn.exceptions import InputError

HELP = "a robot or model as URDF, MJCF, FMU, C kinematics, a controller's reference, or RAPID"


@dataclass(frozen=True)
class Made:
    """What a format makes of the input.

    Attributes:
        files: What to write.
        said: One line for a person.
        result: The format's part of the JSON result.
        warnings: Sentences.
    """

    files: dict[Path, str | Callable[[Path], None]]
    said: str
    result: dict[str, Any]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Format:
    """One choice of --to.

    Attributes:
        ending: Of the file.
        make: From arguments and the file's name.
        moves: Whether --motion is needed.
    """

    ending: str
    make: Callable[[argparse.Namespace, Path], Made]
    moves: bool = False


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "model", metavar="MODEL.yaml|ROBOT", type=Path,
        help="a model file of identify or diagnose; for fmu, c, reference and rapid also a robot (file or short name)",
    )  # fmt: skip
    parser.add_argument("--to", choices=tuple(FORMATS), required=True, help="format")
    parser.add_argument("--out", metavar="FILE", type=Path, help="by default beside the model, or here for a robot")
    add_robot_options(parser)
    code = parser.add_argument_group("--to c")
    code.add_argument("--name", metavar="NAME", help="with which all functions begin (default: the robot's name)")
    sent = parser.add_argument_group("--to reference, rapid")
    sent.add_argument("--motion", metavar="MOTION.csv", type=Path, help="t, q_ref_J (or q_J) of each joint")
    sent.add_argument("--correction", metavar="FILE.csv", type=Path, help="add this learned correction to the motion")
    sent.add_argument(
        "--period", metavar="S", type=positive, default=0.004, help="the controller's sample period (default 0.004)"
    )
    sent.add_argument("--resample", action="store_true", help="interpolate a motion that has another sample period")
    for what, unit in (
        ("speed", "per s"),
        ("acceleration", "per s^2"),
        ("force", "N or N m"),
        ("largest-correction", "m or rad"),
    ):
        sent.add_argument(
            f"--{what}", metavar="X", type=positive, nargs="+", help=f"limit, one or one a joint [{unit}]"
        )
    sent.add_argument(
        "--by", choices=("joints", "tool"), default="joints", help="rapid: MoveAbsJ or MoveL (default joints)"
    )
    sent.add_argument(
        "--tolerance",
        metavar="X",
        type=positive,
        default=1e-4,
        help="rapid: of straight moves [m or rad] (default 1e-4)",
    )
    parser.set_defaults(own_file=lambda args: f"{args.model.name.split('.')[0]}{FORMATS[args.to].ending}")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Write the file."""
    chosen = FORMATS[args.to]
    out = args.out or _beside(args, chosen.ending)
    if out.suffix != chosen.ending:
        raise InputError("cannot_write", f"{out}: what --to {args.to} writes ends in {chosen.ending}")
    if chosen.moves != (args.motion is not None):
        raise InputError(
            "bad_option", f"--to {args.to} {'needs --motion MOTION.csv' if chosen.moves else 'takes no --motion'}"
        )
    with show_progress(args.quiet) as step:
        step("writing")
        made = chosen.make(args, out)
    given = [p for p in (args.model, args.motion, args.correction) if p is not None and p.is_file()]
    return Outcome(
        result={"out": str(out), "format": args.to, **made.result},
        warnings=made.warnings,
        inputs=given,
        show=lambda console: console.print(made.said, markup=False),
        files=made.files,
    )


def _beside(args: argparse.Namespace, ending: str) -> Path:
    if is_model_file(args.model):
        return args.model.with_suffix(ending)
    stem = args.motion.stem if args.motion is not None else args.model.name.split(".")[0]
    return Path(f"{stem}_reference{ending}" if ending == ".csv" else f"{stem}{ending}")


def _model(args: argparse.Namespace):
    """Return the model; of a robot its nominal rigid body without effects."""
    from tau_dyn.model import Model

    if is_model_file(args.model):
        return Model.load(args.model)
    args.robot = str(args.model)
    return Model.of(load_robot_from(args), [])


def _exchanged(args: argparse.Namespace, out: Path) -> Made:
    """Return URDF or MJCF."""
    from tau_dyn.exchange import build_mjcf, build_urdf
    from tau_dyn.model import Model

    if not is_model_file(args.model):
        learned = f"tau-dyn identify {args.model} LOG --out model.yaml"
        raise InputError(
            "unsupported",
            f"{args.model}: --to {args.to} takes a model file, as `{learned}` writes it; a robot's file is there already",
        )
    model = Model.load(args.model)
    made = build_urdf(model) if args.to == "urdf" else build_mjcf(model)
    links = len(model.robot.links)
    kept = f"; nominal values, not identified: {', '.join(made.nominal)}" if made.nominal else ""
    shared = f"; one of many splits with the same forces: {', '.join(made.split)}" if made.split else ""
    carriers = "link that carries" if links == 1 else "links that carry"
    said = f"{model.robot.name} with {links} {carriers} mass -> {out}{kept}{shared}"
    return Made(
        {out: made.text}, said, {"left_out": list(made.left_out), "nominal": list(made.nominal)}, tuple(made.left_out)
    )


def _fmu(args: argparse.Namespace, out: Path) -> Made:
    """Return an FMU for co-simulation."""
    from tau_dyn.exchange import build_fmu

    model = _model(args)
    made = build_fmu(model)

    def write(path: Path) -> None:
        path.write_bytes(made.content)

    said = f"{model.robot.name} for FMI 2.0 co-simulation, its equations compared with the simulator's -> {out}"
    result = {"left_out": list(made.left_out), "nominal": list(made.nominal), "difference": made.difference}
    return Made({out: write}, said, result, made.left_out)


def _kinematics(args: argparse.Namespace, out: Path) -> Made:
    """Return C kinematics and their header."""
    from tau_dyn.codegen import (
        build_identifiers,
        build_kinematics,
        include_header,
        locate_header,
        write_kinematics_source,
    )

    robot = _model(args).robot
    name = args.name or build_identifiers([robot.name])[0].lstrip("_0123456789") or "robot"
    header = locate_header(out)
    program = build_kinematics(robot)
    source, declared = write_kinematics_source(program, name)
    functions = [f"{name}_{x}" for x in ("fk", "jacobian", *(() if program.no_inverse else ("ik",)))]
    lacking = (f"{robot.name}: no inverse kinematics, since {program.no_inverse}",) if program.no_inverse else ()
    said = f"{', '.join(functions)}: within {max(program.difference, 1e-16):.1g} of Python's -> {out} and {header}"
    result = {
        "functions": functions,
        "kind": program.kind,
        "difference": program.difference,
        "joints": list(robot.actuated),
    }
    return Made({out: include_header(source, name, header), header: declared}, said, result, lacking)


def _motion(args: argparse.Namespace):
    """Return the model and the motion that a controller may be given."""
    from tau_dyn.control import CommandLimits, apply_correction, build_reference, read_correction
    from tau_dyn.simulate import Trajectory

    model = _model(args)
    given = {n: getattr(args, n) for n in ("speed", "acceleration", "force")} | {"correction": args.largest_correction}
    limits = CommandLimits.of(model.robot, **{k: x for k, x in given.items() if x is not None})
    motion = Trajectory.from_csv(args.motion, model.robot.actuated)
    motion = build_reference(model, motion, period=args.period, resample=args.resample, limits=limits)
    if args.correction is not None:
        correction = read_correction(args.correction, model.robot.actuated, period=args.period)
        motion = apply_correction(model, motion, correction, limits)
    return model, motion


def _reference(args: argparse.Namespace, out: Path) -> Made:
    """Return a controller's reference file."""
    model, motion = _motion(args)
    said = f"{motion.n_samples} samples, one every {1e3 * args.period:g} ms, within the limits of {model.robot.name} -> {out}"
    result = {"samples": motion.n_samples, "period": args.period, "joints": list(motion.joints)}
    return Made({out: motion.to_csv}, said, result, motion.notes)


def _rapid(args: argparse.Namespace, out: Path) -> Made:
    """Return a RAPID module."""
    from tau_dyn.control import format_rapid_motion

    model, motion = _motion(args)
    text = format_rapid_motion(
        model.robot, motion, by=args.by, tolerance=args.tolerance, **({"name": args.name} if args.name else {})
    )
    said = f"{motion.duration:.4g} s by {'MoveAbsJ' if args.by == 'joints' else 'MoveL'} -> {out}"
    return Made({out: text}, said, {"duration": motion.duration, "by": args.by}, motion.notes)


FORMATS: dict[str, Format] = {
    "urdf": Format(".urdf", _exchanged),
    "mjcf": Format(".xml", _exchanged),
    "fmu": Format(".fmu", _fmu),
    "c": Format(".c", _kinematics),
    "reference": Format(".csv", _reference, moves=True),
    "rapid": Format(".mod", _rapid, moves=True),
}
"""What --to offers; another format is one more line here."""
