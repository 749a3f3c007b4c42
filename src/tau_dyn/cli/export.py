"""`tau-dyn export` and `tau-dyn feedforward export`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.export_filters import FilterOptions, write_filter
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError
from tau_dyn.message_codes import CodedWarning, get_code

_CODE = Group("--to c, shaper, notch")
_DRIVES = Group("--to mjlab, isaaclab")
_TRAINED = Group("--to mjlab, isaaclab, playground")
_SENT = Group("--to reference, rapid")
_SAMPLED = Group("--to reference, rapid, shaper, notch")


@dataclass(frozen=True)
class Made:
    """The output of a format.

    Attributes:
        files: Files to write.
        said: One line for a person.
        result: The format's part of the JSON result.
        warnings: Sentences.
    """

    files: dict[Path, str | Callable[[Path], None]]
    said: str
    result: dict[str, Any]
    warnings: tuple[str, ...] = ()


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of single formats.

    Attributes:
        name: Prefix of all functions (default: the robot's name)
        actuators: Fitted actuators, for their delays (a file of `actuators`)
        samples: Samples of `identify --samples`, to randomise a trainer's robots; writes FILE.npz next to FILE.py
        motion: t, q_ref_J (or q_J) of each joint
        correction: Add this learned correction to the motion
        period: The controller's sample period
        resample: Interpolate a motion if the period is not a whole number of samples (else every n-th sample is used)
        speed: Limit, one or one per joint [per s]
        acceleration: Limit, one or one per joint [per s^2]
        force: Limit, one or one per joint [N or N m]
        largest_correction: Limit, one or one per joint [m or rad]
        by: rapid: MoveAbsJ or MoveL
        tolerance: rapid: tolerance of straight moves [m or rad]
    """

    name: Annotated[str | None, Parameter(group=_CODE, metavar="NAME")] = None
    actuators: Annotated[Path | None, Parameter(group=_DRIVES, metavar="FILE.yaml")] = None
    samples: Annotated[Path | None, Parameter(group=_TRAINED, metavar="SAMPLES.parquet")] = None
    motion: Annotated[Path | None, Parameter(group=_SENT, metavar="MOTION.csv")] = None
    correction: Annotated[Path | None, Parameter(group=_SENT, metavar="FILE.csv")] = None
    period: Annotated[args.Positive, Parameter(group=_SAMPLED, metavar="S")] = 0.004
    resample: Annotated[bool, Parameter(group=_SENT)] = False
    speed: Annotated[args.Positives | None, Parameter(group=_SENT, metavar="X")] = None
    acceleration: Annotated[args.Positives | None, Parameter(group=_SENT, metavar="X")] = None
    force: Annotated[args.Positives | None, Parameter(group=_SENT, metavar="X")] = None
    largest_correction: Annotated[args.Positives | None, Parameter(group=_SENT, metavar="X")] = None
    by: Annotated[Literal["joints", "tool"], Parameter(group=_SENT)] = "joints"
    tolerance: Annotated[args.Positive, Parameter(group=_SENT, metavar="X")] = 1e-4


@dataclass(frozen=True)
class _Request:
    """An export: a model file or a robot, the format, and the destination."""

    source: Path
    to: str
    out: Path
    options: ExportOptions
    robot_options: args.RobotOptions = field(default_factory=args.RobotOptions)
    filter_options: FilterOptions = field(default_factory=FilterOptions)

    def load_model(self):
        """Return the model; for a robot its nominal rigid body without effects."""
        return load_model(self.source, self.robot_options)


def load_model(source: Path, options: args.RobotOptions):
    """Return a file's model; for a robot its nominal rigid body without effects."""
    from tau_dyn.model import Model

    return Model.load(source) if args.is_saved_model(source) else Model.of(options.load(str(source)), [])


def export(
    model: Annotated[Path, Parameter(name="MODEL.yaml|ROBOT")],
    /,
    *,
    to: Literal[
        "urdf",
        "mjcf",
        "sdf",
        "fmu",
        "bam",
        "mjlab",
        "isaaclab",
        "playground",
        "c",
        "reference",
        "rapid",
        "shaper",
        "notch",
    ],
    out: Annotated[
        Path | None, args.build_destination("FILE", "Default: next to the model, or here for a robot")
    ] = None,
    options: ExportOptions = ExportOptions(),
    filter_options: FilterOptions = FilterOptions(),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """A robot, its model or its modes for another program: URDF, MJCF, SDF, FMU, drives, C, references, RAPID, filters.

    Args:
        model: A model file of identify or diagnose; or a robot (file or short name), exported as its nominal rigid body;
            for shaper and notch, a result (--json) or model of modes, or a robot with springs
        to: Format
    """
    chosen = FORMATS[to]
    path = out or _name_beside(model, options.motion, chosen.ending)
    if path.suffix != chosen.ending:
        raise InputError("cannot_write", f"{path}: what --to {to} writes ends in {chosen.ending}")
    if chosen.moves != (options.motion is not None):
        raise InputError(
            "bad_option", f"--to {to} {'needs --motion MOTION.csv' if chosen.moves else 'takes no --motion'}"
        )
    for name, formats in _ONLY_FOR.items():
        if getattr(options, name) is not None and to not in formats:
            raise InputError("bad_option", f"--{name} goes with --to {', '.join(formats)}, not with {to}")
    with show_progress(output.quiet) as step:
        step("writing")
        made = chosen.make(_Request(model, to, path, options, robot_options, filter_options))
    files = (model, options.motion, options.correction, options.actuators, options.samples)
    given = [p for p in files if p is not None and p.is_file()]
    return Outcome(
        result={"out": str(path), "format": to, **made.result},
        warnings=made.warnings,
        inputs=given,
        lines=[made.said],
        files=made.files,
    )


def name_export(values: dict[str, Any]) -> str:
    """Return the usual name of the file that `export` writes."""
    return f"{values['model'].name.split('.')[0]}{FORMATS[values['to']].ending}"


def _name_beside(model: Path, motion: Path | None, ending: str) -> Path:
    if args.is_saved_model(model):
        return model.with_suffix(ending)
    stem = motion.stem if motion is not None else model.name.split(".")[0]
    return Path(f"{stem}_reference{ending}" if ending == ".csv" else f"{stem}{ending}")


def _make_exchanged(request: _Request) -> Made:
    """Return URDF, MJCF or SDF."""
    from tau_dyn.exchange import build_mjcf, build_sdf, build_urdf, describe_price
    from tau_dyn.results import format_list

    model = request.load_model()
    if request.to == "mjcf":
        made = build_mjcf(model, f"{request.out.stem}.")
    else:
        made = build_urdf(model, request.out.parent) if request.to == "urdf" else build_sdf(model)
    links = len(model.robot.links)
    kept = f"; nominal values, not identified: {format_list(made.nominal)}" if made.nominal and model.provenance else ""
    shared = f"; one of many splits with the same forces: {format_list(made.split)}" if made.split else ""
    carriers = "link that carries" if links == 1 else "links that carry"
    beside = request.out.with_name(f"{request.out.stem}_effects.py")
    where = f"{request.out} and {beside}" if made.callback else request.out
    drawn = f" and {len(made.meshes)} meshes {request.out.stem}.*.stl" if made.meshes else ""
    said = f"{model.robot.name} with {links} {carriers} mass -> {where}{drawn}{kept}{shared}"
    versions = [made.carried, *([made.told] if made.told else [])]
    changed = (made.carried.parameters.values != model.parameters.values).any()
    price = [describe_price(model, versions, request.source.parent)] if changed else []
    result = {
        "left_out": list(made.left_out),
        "nominal": list(made.nominal),
        "price": price[0] if price else None,
        "callback": str(beside) if made.callback else None,
        "by_callback": list(made.by_callback),
    }
    files: dict[Path, Any] = {request.out: made.text, **({beside: made.callback} if made.callback else {})}
    files |= {request.out.parent / name: partial(_write_bytes, content) for name, content in made.meshes.items()}
    return Made(files, said, result, (*made.left_out, *made.by_callback, *price))


_ONLY_FOR = {
    "samples": ("mjlab", "isaaclab", "playground"),
    "actuators": ("bam", "mjlab", "isaaclab"),
    "correction": ("reference", "rapid"),
}
"""Options that name a file, and the formats that read it."""


def _make_randomisation(request: _Request) -> Made:
    """Return samples as a trainer's module and its table."""
    from tau_dyn.exchange import build_randomisation, read_samples

    samples = request.options.samples
    if samples is None:
        raise InputError("missing_input", f"--to {request.to} needs --samples SAMPLES.parquet of identify --samples")
    model, beside = request.load_model(), request.out.with_suffix(".npz")
    made = build_randomisation(model, read_samples(samples, model), request.to, beside.name)  # type: ignore[arg-type]
    said = f"{made.n_samples} samples of {model.robot.name} -> {request.out} and {beside}"
    result = {"out": [str(request.out), str(beside)], "samples": made.n_samples, "left_out": list(made.left_out)}
    return Made({request.out: made.module, beside: partial(_write_bytes, made.table)}, said, result, made.left_out)


def _make_drives(request: _Request) -> Made:
    """Return the drives for BAM, mjlab or Isaac Lab; with samples, their randomisation."""
    if request.options.samples is not None:
        return _make_randomisation(request)
    from tau_dyn.control.iterative import read_actuators
    from tau_dyn.exchange import build_drive_files, describe_price

    model, fitted = request.load_model(), request.options.actuators
    joints = model.robot.driven
    delays = None
    if fitted is not None:
        delays = {j: a.delay for j, a in zip(joints, read_actuators(fitted, joints), strict=True)}
    made = build_drive_files(model, request.to, delays)  # type: ignore[arg-type]
    one = next(iter(made.values()))
    names = {request.out.with_stem(f"{request.out.stem}_{j}") if j else request.out: x.text for j, x in made.items()}
    changed = (one.carried.effect_parameters.values != model.effect_parameters.values).any()
    price = [describe_price(model, [one.carried], request.source.parent)] if changed else []
    count = len(made) if request.to == "bam" else len(joints)
    drives = f"{count} {'drive' if count == 1 else 'drives'}"
    said = f"{drives} of {model.robot.name} -> {', '.join(map(str, names))}"
    result = {
        "out": [str(path) for path in names],
        "left_out": list(one.left_out),
        "price": price[0] if price else None,
    }
    return Made(dict(names), said, result, (*one.left_out, *price))


def _make_fmu(request: _Request) -> Made:
    """Return an FMU for co-simulation."""
    from tau_dyn.exchange import build_fmu

    model = request.load_model()
    made = build_fmu(model)

    said = f"{model.robot.name} for FMI 2.0 co-simulation, its equations compared with the simulator's -> {request.out}"
    result = {"left_out": list(made.left_out), "nominal": list(made.nominal), "difference": made.difference}
    return Made({request.out: partial(_write_bytes, made.content)}, said, result, made.left_out)


def _write_bytes(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _make_kinematics(request: _Request) -> Made:
    """Return C kinematics and their header."""
    from tau_dyn.codegen import (
        build_identifiers,
        build_kinematics,
        include_header,
        locate_header,
        write_kinematics_source,
    )

    robot = request.load_model().robot
    name = request.options.name or build_identifiers([robot.name])[0].lstrip("_0123456789") or "robot"
    header = locate_header(request.out)
    program = build_kinematics(robot)
    source, declared = write_kinematics_source(program, name)
    functions = [f"{name}_{x}" for x in ("fk", "jacobian", *(() if program.no_inverse else ("ik",)))]
    lacking = (f"{robot.name}: no inverse kinematics, since {program.no_inverse}",) if program.no_inverse else ()
    said = (
        f"{', '.join(functions)}: within {max(program.difference, 1e-16):.1g} of Python's -> {request.out} and {header}"
    )
    result = {
        "functions": functions,
        "kind": program.kind,
        "difference": program.difference,
        "joints": list(robot.driven),
    }
    return Made({request.out: include_header(source, name, header), header: declared}, said, result, lacking)


def _build_motion(request: _Request):
    """Return the model and the checked motion for a controller."""
    from tau_dyn.control import (
        CommandLimits,
        apply_correction,
        build_reference,
        count_samples_in_period,
        read_correction,
    )
    from tau_dyn.simulate import Trajectory

    options, model = request.options, request.load_model()
    joints = model.robot.actuated
    given = {n: getattr(options, n) for n in ("speed", "acceleration", "force")}
    given |= {"correction": options.largest_correction}
    limits = CommandLimits.of(model.robot, **{k: x for k, x in given.items() if x is not None})
    motion = Trajectory.from_csv(str(options.motion), joints)
    whole = count_samples_in_period(motion, options.period) > 0
    motion = build_reference(model, motion, period=options.period, resample=options.resample or whole, limits=limits)
    if options.correction is not None:
        correction = read_correction(options.correction, joints, period=options.period)
        motion = apply_correction(model, motion, correction, limits)
    return model, motion


def _make_reference(request: _Request) -> Made:
    """Return a controller's reference file."""
    model, motion = _build_motion(request)
    period = 1e3 * request.options.period
    said = (
        f"{motion.n_samples} samples, one every {period:g} ms, within the limits of {model.robot.name} -> {request.out}"
    )
    result = {"samples": motion.n_samples, "period": request.options.period, "joints": list(motion.joints)}
    return Made({request.out: motion.to_csv}, said, result, motion.notes)


def _make_rapid(request: _Request) -> Made:
    """Return a RAPID module."""
    from tau_dyn.control import build_waypoints, format_rapid_motion

    model, motion = _build_motion(request)
    by, tolerance = request.options.by, request.options.tolerance
    text = format_rapid_motion(
        model.robot,
        motion,
        by=by,
        tolerance=tolerance,
        **({"name": request.options.name} if request.options.name else {}),
    )
    found = build_waypoints(model.robot, motion, by=by, tolerance=tolerance)
    move = "MoveAbsJ" if by == "joints" else "MoveL"
    said = f"{motion.duration:.4g} s by {len(found.index)} places of {move} -> {request.out}"
    result = {"duration": motion.duration, "by": by, "places": len(found.index), "deviation": found.deviation}
    loose = CodedWarning(
        "path_deviates",
        f"straight moves of 0.1 s or more leave the motion by up to {found.deviation:.2g} m or rad, more than the tolerance of "
        f"{tolerance:g}; move slower, or send a reference file",
    )
    return Made({request.out: text}, said, result, (*motion.notes, *([loose] if found.deviation > tolerance else [])))


def _make_filter(request: _Request) -> Made:
    """Return an input shaper or a notch filter in C."""
    options = request.options
    made = write_filter(
        request.to,
        request.source,
        request.out,
        options.period,
        options.name,
        request.filter_options,
        request.robot_options,
    )
    return Made(made.files, made.said, made.result, made.warnings)


@dataclass(frozen=True)
class Format:
    """One choice of --to.

    Attributes:
        ending: Ending of the file.
        make: Function that makes the output of a request.
        moves: Whether --motion is needed.
    """

    ending: str
    make: Callable[[_Request], Made]
    moves: bool = False


FORMATS: dict[str, Format] = {
    "urdf": Format(".urdf", _make_exchanged),
    "mjcf": Format(".xml", _make_exchanged),
    "sdf": Format(".sdf", _make_exchanged),
    "fmu": Format(".fmu", _make_fmu),
    "bam": Format(".json", _make_drives),
    "mjlab": Format(".py", _make_drives),
    "isaaclab": Format(".py", _make_drives),
    "playground": Format(".py", _make_randomisation),
    "c": Format(".c", _make_kinematics),
    "reference": Format(".csv", _make_reference, moves=True),
    "rapid": Format(".mod", _make_rapid, moves=True),
    "shaper": Format(".c", _make_filter),
    "notch": Format(".c", _make_filter),
}
"""Choices of --to; a new format needs a line here and a word in the signature of `export`."""

_ENDINGS = {"c": ".c", "python": ".py", "ros2_control": ".yaml"}


def export_feedforward(
    model: Annotated[Path, Parameter(name="MODEL.yaml|ROBOT")],
    /,
    *,
    to: Literal["c", "python", "ros2_control"],
    out: Annotated[
        Path, args.build_destination("FILE", "FILE.c (and FILE.h), FILE.py or FILE.yaml (and .c, .h, .hpp)")
    ],
    name: Annotated[str, Parameter(metavar="NAME")] = "tau_ff",
    width: Annotated[args.Positives, Parameter(metavar="V")] = (0.01,),
    shape: Literal["ramp", "tanh"] = "ramp",
    steady: bool = False,
    plugin: Annotated[str, Parameter(metavar="TYPE")] = "tau_ff_controllers/FeedforwardController",
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """A model's feedforward tau_ff(q, v, a) as code for a controller: dependency-free C, Python, or for ros2_control.

    Args:
        model: A model file of identify or diagnose, or a robot, exported as its nominal rigid body
        to: Language
        name: Name of the function
        width: Speed within which the sign of friction is smoothed, one or one per joint [m/s or rad/s]
        shape: Shape of the smoothed sign
        steady: Leave out effects that need a history, and list them
        plugin: ros2_control: type of the controller that includes FILE.hpp
    """
    import numpy as np

    ending = _ENDINGS[to]
    if out.suffix != ending:
        raise InputError("cannot_write", f"{out}: what --to {to} writes ends in {ending}")
    with show_progress(output.quiet) as step:
        step("tracing")
        from tau_dyn.codegen import (
            ARGUMENTS,
            build_program,
            include_header,
            locate_header,
            write_c_source,
            write_python_source,
            write_ros2_control,
        )
        from tau_dyn.control import Feedforward
        from tau_dyn.effects import acts_on_recording

        loaded = load_model(model, robot_options)
        recorded = [effect for effect in loaded.effects if acts_on_recording(effect)]
        kept = loaded.steady(ARGUMENTS) if steady else loaded.only(e for e in loaded.effects if e not in recorded)
        dropped = [effect for effect in loaded.effects if effect not in kept.effects]
        program = build_program(Feedforward(kept, width=width[0] if len(width) == 1 else np.array(width), shape=shape))
        if to == "c":
            header = locate_header(out)
            source, declared = write_c_source(program, name)
            files: dict[Path, Any] = {out: include_header(source, name, header), header: declared}
        elif to == "ros2_control":
            files = {**write_ros2_control(program, name, out, plugin)}
        else:
            files = {out: write_python_source(program, name)}
    size = len(program.graph.needed(program.outputs))
    result = {
        "out": [str(path) for path in files],
        "language": to,
        "function": name,
        "joints": list(kept.robot.driven),
        "signals": list(program.signals),
        "expressions": size,
        "difference": program.difference,
        "left_out": [effect.name for effect in dropped],
    }
    said = (
        f"{name}({', '.join(('q', 'v', 'a', *program.signals))}): {size} expressions, within "
        f"{max(program.difference, 1e-16):.1g} of Python's -> {' and '.join(str(path) for path in files)}"
    )
    return Outcome(
        result=result,
        warnings=[
            *(w for w in loaded.robot.warnings if get_code(w) == "redundant_drives"),
            *(
                f"the feedforward leaves out {effect.name}, "
                + (
                    "which distorts the recorded force: the force is the one at the reference's own time"
                    if effect in recorded
                    else "which a single state does not determine"
                )
                for effect in dropped
            ),
        ],
        inputs=[model] if args.is_saved_model(model) else robot_options.list_files(str(model)),
        lines=[said],
        files=files,
    )


def name_feedforward(values: dict[str, Any]) -> str:
    """Return the usual name of the file that `feedforward export` writes."""
    return f"{values['name']}{_ENDINGS[values['to']]}"
