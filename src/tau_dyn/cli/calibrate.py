"""`tau-dyn calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256
from tau_dyn.message_codes import CodedWarning

Frames = Annotated[tuple[Literal["device", "tool"], ...], Parameter(consume_multiple=args.SEVERAL, metavar="FRAME")]
Sigmas = Annotated[tuple[float, ...], Parameter(consume_multiple=args.SEVERAL, metavar="SIGMA")]


def calibrate(
    robot: args.RobotName,
    poses: Annotated[Path, Parameter(name="POSES.csv")],
    /,
    *,
    holdout: Annotated[args.Paths, Parameter(metavar="POSES.csv")] = (),
    columns: args.ColumnMapFile = None,
    encoders: Annotated[args.Strings, Parameter(metavar="JOINT")] = (),
    model: Annotated[str, Parameter(metavar="NAME")] = "auto",
    residual: Literal["forward", "closure", "inverse"] = "forward",
    robust: Literal["none", "huber", "biweight"] = "none",
    known: Frames = (),
    fix: Annotated[args.Strings, Parameter(metavar="NAME")] = (),
    free: Annotated[args.Strings, Parameter(metavar="NAME")] = (),
    accuracy: Sigmas = (),
    prior: Sigmas = (),
    correct: Annotated[Path | None, Parameter(metavar="Q.csv")] = None,
    corrected: Annotated[Path | None, Parameter(metavar="Q.csv", validator=args.require_csv_name)] = None,
    out: Annotated[Path | None, args.build_destination("MODEL.yaml", "Write the calibrated robot here")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Geometry with uncertainty from measured poses: selected model, gain of each step, parameters that are not identifiable.

    Args:
        poses: Q_J of every actuated joint and x_tool y_tool z_tool [qx_tool ..] in the measuring device's frame, or
            distance_tool, hole, plane, sphere; known loads at the tool in load [kg], fx_tool .. [N], mx_tool .. [N m]
        holdout: Poses used only for the final errors (default: a quarter of many poses, or cross-validation)
        encoders: Passive joints of loops whose positions q_J were measured, in addition to the tool or instead of it
        model: auto; frames, ideal, nonparallel, complete or paths, as the robot offers them; with +periodic, +piecewise,
            +compliant, +elastic, +backlash, +delay, +gravity, +eccentric, +coupling:j3/j2 (a share) or coupling:j3=-j2 (all),
            each optionally with joints: nonparallel+periodic:cart2
        residual: Residual to minimise
        robust: Weights (gross outliers are left out in any case)
        known: Known frames: the device measures in the robot's base frame, the target is the tool frame
        fix: Parameters that keep their nominal values
        free: Parameters to estimate in addition to the model's
        accuracy: Standard error of a measured coordinate [m], and optionally of an orientation [rad]; held-out errors are
            compared with it (default: columns x_tool_stderr .., or repeated poses)
        prior: Standard deviation of the built robot from its file: of lengths [m], and optionally of angles [rad] (default
            0.01 0.01)
        correct: Joint positions q_J that a controller computed with the robot file; needs --corrected
        corrected: Write the positions at which the calibrated robot reaches the poses intended by --correct
    """
    if (correct is None) != (corrected is None):
        raise InputError(
            "bad_option", "--correct Q.csv and --corrected Q.csv go together: positions to read and to write"
        )
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.calibrate import PassiveEncoders, calibrate as calibrate_robot, save_calibration
        from tau_dyn.kinematics import read_positions
        from tau_dyn.robot import read_annotations

        machine = robot_options.load(robot)
        reading = {
            "columns": columns,
            "mimics": read_annotations(machine.urdf, machine.source).mimics,
            "encoders": PassiveEncoders.of(machine, encoders) if encoders else None,
        }
        machine, measured = _read_poses(robot_options, robot, machine, poses, reading)
        wanted = None if correct is None else read_positions(args.read_columns(correct), machine, str(correct))
        held, hashes, warnings = _read_held_out(holdout, poses, machine, reading)
        found = calibrate_robot(
            machine,
            measured,
            held,
            model,
            fix=list(fix),
            free=list(free),
            residual=residual,
            robust=robust,
            device="device" not in known,
            tool="tool" not in known,
            accuracy=accuracy,
            prior=prior,
            seed=output.seed,
            progress=step,
        )
    read = [(str(poses), measured.sha256), *hashes, *([(str(correct), compute_sha256(correct))] if correct else [])]
    files: dict[Path | None, Any] = {out: lambda path: save_calibration(path, found)}
    more: list[str] = []
    if wanted is not None and corrected is not None:
        files[corrected], more = _correct(found, wanted)

    return Outcome(
        result=found.to_dict(),
        warnings=[*machine.warnings, *warnings, *found.warnings, *more],
        inputs=[*robot_options.list_files(robot), *read],
        files=files,
        named={"model": out},
        found=found,
        context={"poses": read},
    )


def _read_poses(options: args.RobotOptions, robot: str, machine, poses: Path, reading: dict[str, Any]):
    """Return the robot and its measured poses; joints that do not move the tool are held still if the poses lack one.

    Raises:
        InputError: A required column is missing, or cells are not numbers.
    """
    from tau_dyn.calibrate import read_poses

    try:
        return machine, read_poses(poses, machine.actuated, **reading)
    except InputError as fault:
        carrying = options.hold_silent_joints(machine, robot, [])
        if fault.code != "missing_column":
            raise
        if carrying is machine:
            hint = "" if machine.tool else ". If some joints do not move the tool, name its frame with --tool"
            raise InputError(fault.code, f"{fault}{hint}") from None
    return carrying, read_poses(poses, carrying.actuated, **reading)


def _read_held_out(holdout: tuple[Path, ...], poses: Path, robot, reading: dict[str, Any]):
    from tau_dyn.calibrate import join_pose_sets, read_poses

    same = [path for path in holdout if path.resolve() == poses.resolve()]
    said = [f"{path} is both fitted and held out; it counts as fitted only" for path in same]
    sets = [(path, read_poses(path, robot.actuated, **reading)) for path in holdout if path not in same]
    if not sets:
        return None, [], said
    return join_pose_sets([s for _, s in sets]), [(str(path), s.sha256) for path, s in sets], said


def _correct(found, wanted) -> tuple[str, list[str]]:
    """Return corrected positions as CSV text, and a warning if some have no solution."""
    import numpy as np
    import pandas as pd

    from tau_dyn.calibrate import build_compensation

    robot = found.robot
    made = build_compensation(robot, found.fit.geometry, found.fit.theta)(wanted)
    table = pd.DataFrame(made.q, columns=[f"q_{joint}" for joint in robot.actuated]).assign(reason=made.reason)
    lost = np.flatnonzero(~made.ok)
    text = table.to_csv(index=False, float_format="%.12g")
    if not len(lost):
        return text, []
    said = f"{len(lost)} of {len(wanted)} positions cannot be corrected; row {lost[0] + 1}: {made.reason[lost[0]]}"
    return text, [CodedWarning("not_corrected", said)]
