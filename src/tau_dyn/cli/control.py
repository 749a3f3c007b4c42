"""`tau-dyn actuators`, `learn`, `observe` and `feedforward share`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli.arguments import (
    ColumnMapFile,
    Finites,
    NotNegative,
    Output,
    Positive,
    Positives,
    RobotOptions,
    Strings,
    Whole,
    build_destination,
    describe_robot_or_model,
    read_columns,
)
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError
from tau_dyn.results import to_plain

if TYPE_CHECKING:
    import numpy as np

    from tau_dyn.log import Log
    from tau_dyn.simulate import Trajectory

_COLUMNS = Group("Columns, by name")
_LAW = Group("How an error becomes a correction")
_TOOL = Group("Learning the tool")
_FILTER = Group("What sees the tool: one of the three")
_AXES = ("x", "y", "z")


def actuators(
    logs: Annotated[tuple[str, ...], Parameter(name="LOG")],
    /,
    *,
    inputs: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    outputs: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    columns: ColumnMapFile = None,
    out: Annotated[Path | None, build_destination("ACTUATORS.yaml", "Write the actuators here, for learn")] = None,
    output: Output = Output(),
) -> Outcome:
    """Gain, time constant and delay of each controlled actuator, with uncertainty, from steps or multisines.

    Args:
        logs: CSV, Parquet, MCAP, a ROS bag or .mat with t, references and positions; never joined
        inputs: References (default: every q_ref_J for which there is a q_J)
        outputs: Positions, in the order of the inputs
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.iterative import fit_actuator_models
        from tau_dyn.log import read_log

        read = [read_log(path, columns) for path in logs]
        found = fit_actuator_models(read, inputs, outputs, step)
    return Outcome(
        result={"axes": to_plain(found.to_rows()), "sample_time_s": found.dt},
        warnings=[*(w for log in read for w in log.warnings), *found.warnings],
        inputs=[*((path, log.sha256) for path, log in zip(logs, read, strict=True)), *([columns] if columns else [])],
        files={out: found.save} if out else {},
        named={"actuators": out},
        found=found,
    )


def learn(
    reference: Annotated[Path, Parameter(name="REFERENCE.csv")],
    trial: Annotated[str | None, Parameter(name="TRIAL")] = None,
    /,
    *,
    history: Annotated[Strings, Parameter(metavar="FILE")] = (),
    actuators: Annotated[Path | None, Parameter(metavar="ACTUATORS.yaml")] = None,
    model: Annotated[Path | None, Parameter(metavar="MODEL.yaml")] = None,
    correction: Annotated[Path | None, Parameter(metavar="FILE.csv")] = None,
    columns: ColumnMapFile = None,
    gain: Annotated[Positive | None, Parameter(group=_LAW, metavar="X")] = None,
    shift: Annotated[Whole | None, Parameter(group=_LAW, metavar="N")] = None,
    cutoff: Annotated[Positive | None, Parameter(group=_LAW, metavar="HZ")] = None,
    lead: Annotated[NotNegative | None, Parameter(group=_LAW, metavar="S")] = None,
    not_monotone: Annotated[bool, Parameter(group=_LAW)] = False,
    largest_correction: Annotated[Positive | None, Parameter(group=_LAW, metavar="X")] = None,
    robot: Annotated[str | None, Parameter(group=_TOOL, metavar="ROBOT")] = None,
    measured: Annotated[Strings, Parameter(group=_TOOL, metavar="COLUMN")] = (),
    observed: Annotated[Strings, Parameter(group=_TOOL, metavar="FILE")] = (),
    out: Annotated[Path, build_destination("CORRECTION.csv", "Write the next correction here", csv=True)],
    robot_options: RobotOptions = RobotOptions(),
    output: Output = Output(),
) -> Outcome:
    """The next correction of a repeated motion from its trials, each compared with its prediction.

    Args:
        reference: The motion without correction, as export --to reference writes it
        trial: A log with t and q_J, from the motion's first sample on; the last trial
        history: Earlier trials in their order, with their commands as q_ref_J; or all
        actuators: A file of the actuators command (default: estimated from the first trial)
        model: A model with resonances instead, from commands to positions, as modes --out writes it; its inverse is tried
        correction: The correction that was applied in TRIAL
        gain: Part of the error that one iteration removes (default: chosen)
        shift: Shift of the error forwards in time [samples] (default: chosen)
        cutoff: Cutoff frequency of the learning (default: chosen)
        lead: Fading in and out [s] (default: a tenth of the motion)
        not_monotone: Allow convergence that is not monotone
        largest_correction: Refuse a larger one [m or rad] (default: the size of the motion)
        robot: Learn the tool of this robot instead of its drives
        measured: Tool position along x, y, z in the trials (default: x_tool, y_tool, z_tool as far as they are there)
        observed: Results of observe instead, one a trial
    """
    import numpy as np

    if trial is None and (not history or correction is not None):
        raise InputError("bad_option", "learn takes a TRIAL, --history FILE..., or both; --correction belongs to TRIAL")
    if actuators is not None and model is not None:
        raise InputError("bad_option", "learn takes --actuators or --model, not both")
    if robot is None and (measured or observed):
        raise InputError("bad_option", "--measured and --observed are positions of a tool; name its robot with --robot")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.interface import Correction, compute_digest, format_correction_text
        from tau_dyn.control.iterative import (
            LearningOptions,
            ToolAxes,
            compute_learning_step,
            read_resonant_drives,
            read_saved_actuators,
        )
        from tau_dyn.simulate import Trajectory

        joints = _list_joints(reference)
        motion = Trajectory.from_csv(str(reference), joints)
        dt = motion.duration / (motion.n_samples - 1)
        logs = [_read_trial(path, columns, motion, dt) for path in (*history, *([trial] if trial else ()))]
        told = [log.joint("q_ref", joints)[: motion.n_samples] for log in logs[: len(history)]]
        if trial is not None:
            told.append(_read_command(logs[-1], bool(history), correction, motion, joints, dt))
        names, wanted, stderr, tool, shown = joints, motion.q, None, None, logs
        if robot is None:
            seen = [_read_positions(log, motion) for log in logs]
        else:
            shown = [_read_trial(path, None, motion, dt) for path in observed] or logs
            if len(shown) != len(logs):
                raise InputError("bad_option", f"--observed takes one file a trial: {len(logs)}, not {len(shown)}")
            tool = ToolAxes.find(robot_options.load(robot), measured, shown[0])
            tool.require_joints(joints, motion.name)
            names, stderr = tool.names, tool.read_stderr(shown[-1])
            seen = [tool.read(log, motion.n_samples) for log in shown]
            wanted, *told = (tool.compute_positions(q) for q in (motion.q, *told))
        allowed = float(np.ptp(wanted, axis=0).max()) if largest_correction is None else largest_correction
        for log, command in zip(logs, told, strict=True):
            _require_small(float(np.abs(command - wanted).max()), allowed, f"{log.name}: its correction")
        step("checking convergence")
        drives, poor = None, ()
        if actuators is not None:
            saved = read_saved_actuators(actuators, names)
            drives, poor = saved.actuators, saved.warnings
        elif model is not None:
            drives = read_resonant_drives(model, names, dt)
        found = compute_learning_step(
            names, dt, wanted, told, seen, drives, LearningOptions(gain, shift, cutoff, lead, not not_monotone),
        )  # fmt: skip
        _require_small(float(np.abs(found.correction).max()), allowed, "the next correction")
        sent = found.correction if tool is None else tool.invert(motion.q, found.correction)
        unseen = [] if tool is None else tool.describe_unseen(found, stderr)
    text = format_correction_text(Correction(joints, dt, sent, compute_digest(motion)))
    checked = found.convergence
    return Outcome(
        result={
            "joints": to_plain(found.to_rows()),
            "law": {"gain": found.gain, "shift_samples": found.shift, "cutoff_hz": found.cutoff_hz},
            "convergence": {
                "largest_singular_value": max(checked.singular), "spectral_radius": checked.radius,
                "monotone": checked.monotone, "stable": checked.stable,
            },
            "trials": to_plain(found.to_trial_rows()),
            "frequencies": to_plain(found.to_frequency_rows()),
            "out": str(out),
        },
        warnings=[*(w for log in logs for w in log.warnings), *poor, *found.warnings, *unseen],
        inputs=[
            reference, *((path, log.sha256) for path, log in zip((*history, trial), logs, strict=False) if path),
            *((path, log.sha256) for path, log in zip(observed, shown, strict=False)),
            *(p for p in (actuators, model, correction, columns) if p),
            *(robot_options.list_files(robot) if robot else []),
        ],
        files={out: text},
        named={"correction": out},
        found=found,
    )  # fmt: skip


def _read_trial(path: str, columns: Path | None, motion: Trajectory, dt: float) -> Log:
    """Return a trial's log.

    Raises:
        InputError: Its sample times differ from the reference's.
    """
    from tau_dyn.log import read_log

    log = read_log(path, columns)
    if abs(log.dt / dt - 1) > 1e-3:
        raise InputError(
            "time_stamps",
            f"{path}: it has a sample every {1e3 * log.dt:.6g} ms, {motion.name} one every {1e3 * dt:.6g} ms; log the trial "
            "at the controller's period",
        )
    return log


MIN_TRIAL_CORRELATION = 0.5
"""Correlation of a drive with its motion from which their ratio is a unit: slow drives lag short motions."""


def _read_positions(log: Log, motion: Trajectory) -> np.ndarray:
    """Return the drives' positions (n, m) of a trial.

    Raises:
        InputError: The log is shorter than the motion, or its positions have another unit or sign.
    """
    from tau_dyn.log import describe_other_scale

    found, n = log.joint("q", motion.joints), motion.n_samples
    if len(found) < n:
        raise InputError("mismatch", f"{log.name}: it has {len(found)} samples, the motion has {n}")
    for joint, q, wanted in zip(motion.joints, found[:n].T, motion.q.T, strict=True):
        said = describe_other_scale(f"q_{joint}", q, f"q_ref_{joint}", wanted, correlated=MIN_TRIAL_CORRELATION)
        if said:
            raise InputError("wrong_unit", f"{log.name}: {said}")
    return found[:n]


def _read_command(
    log: Log, in_log: bool, correction: Path | None, motion: Trajectory, joints: Sequence[str], dt: float
) -> np.ndarray:
    """Return the commands of TRIAL (N, m): reference and correction, or its columns q_ref_J if there are earlier trials."""
    from tau_dyn.control.interface import read_correction, require_same_motion

    if correction is not None:
        given = read_correction(correction, joints, period=dt)
        require_same_motion(motion, given)
        return motion.q + given.dq
    return log.joint("q_ref", joints)[: motion.n_samples] if in_log else motion.q


def _require_small(size: float, allowed: float, what: str) -> None:
    if size > allowed:
        raise InputError(
            "invalid_value",
            f"{what} is up to {size:.3g}, more than the {allowed:.3g} allowed; the robot does not follow its model, the "
            "trial is of another motion, or --largest-correction is too low",
        )


def _list_joints(reference: Path) -> tuple[str, ...]:
    """Return the joints of a reference file, in the order of its columns.

    Raises:
        InputError: The file has no joints.
    """
    joints = tuple(n.removeprefix("q_ref_") for n in read_columns(reference) if n.startswith("q_ref_"))
    if not joints:
        raise InputError(
            "missing_column", f"{reference}: there is no column q_ref_J; export --to reference writes them"
        )
    return joints


def observe(
    log: str,
    robot: str | None = None,
    /,
    *,
    acceleration: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    kinematic: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    model: Annotated[Path | None, Parameter(group=_FILTER, metavar="MODEL.yaml")] = None,
    cutoff: Annotated[Positives | None, Parameter(group=_FILTER, metavar="HZ")] = None,
    camera: Annotated[Path | None, Parameter(group=_FILTER, metavar="POSES.csv")] = None,
    columns: ColumnMapFile = None,
    out: Annotated[
        Path | None,
        build_destination("TOOL.csv", "Write t, positions and their 95 % intervals here", csv=True),
    ] = None,
    robot_options: RobotOptions = RobotOptions(),
    output: Output = Output(),
) -> Outcome:
    """Tool position from the actuators and an accelerometer or a camera that tracks it, with 95 % intervals.

    Args:
        log: CSV, Parquet, MCAP, a ROS bag or .mat, from rest to rest
        robot: Computes the tool position from q_J if --kinematic names no columns
        acceleration: Acceleration of the tool along x, y, z, without gravity [m/s^2]
        kinematic: Tool position along x, y, z, computed from the actuators [m]
        model: Kalman filter: model from computed to true tool positions, as modes --out writes it
        cutoff: Complementary filter: cutoff frequency, one value or one per axis
        camera: Poses that see --times measured during LOG, with its times; needs ROBOT, and no accelerometer
    """
    import numpy as np

    if (model is not None) + (cutoff is not None) + (camera is not None) != 1:
        raise InputError("bad_option", "observe takes either --model MODEL.yaml or --cutoff HZ, or --camera POSES.csv")
    if camera is not None:
        return _observe_by_camera(
            log, robot, camera, bool(acceleration or kinematic), columns, out, robot_options, output
        )
    if not acceleration:
        raise InputError("bad_option", "observe needs --acceleration COLUMN.., along x, y, z, or --camera POSES.csv")
    if bool(kinematic) == (robot is not None):
        raise InputError("bad_option", "the tool's position from the actuators comes from either ROBOT or --kinematic")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.observers import observe_tool, refuse_odd_accelerations
        from tau_dyn.log import read_log
        from tau_dyn.mechanism import forward_kinematics
        from tau_dyn.modes import build_records, load_state_space

        read = read_log(log, columns)
        if robot is None:
            names = kinematic
            (record, *more) = build_records(read, acceleration, kinematic)
            felt, computed, dt = record.u, record.y, record.dt
        else:
            machine = robot_options.load(robot)
            names = [f"{axis}_tool" for axis in _AXES[: len(acceleration)]]
            (record, *more) = build_records(read, acceleration, [f"q_{j}" for j in machine.actuated])
            felt, dt = record.u, record.dt
            computed = forward_kinematics(machine, record.y).poses.position[:, : len(acceleration)]
        if more:
            raise InputError("time_stamps", f"{log}: it has gaps; an observer needs one stretch without any")
        if model is not None and abs(load_state_space(model).model.dt / dt - 1) > 1e-3:
            raise InputError("mismatch", f"{model}: it is made for another sampling step than {log}, {1e3 * dt:g} ms")
        refuse_odd_accelerations(acceleration, felt, names, computed, dt)
        step("estimating")
        given = None if model is None else load_state_space(model).model
        found = observe_tool(names, np.arange(len(felt)) * dt, computed, felt, model=given, cutoff_hz=cutoff or ())
    scale = None if found.error is None else found.error.frequency_scale
    return Outcome(
        result={"axes": to_plain(found.to_rows()), "filter": found.how, "frequency_scale": scale},
        warnings=[*read.warnings, *found.warnings],
        inputs=[
            (log, read.sha256), *(p for p in (model, columns) if p), *(robot_options.list_files(robot) if robot else []),
        ],
        files={out: found.to_csv()} if out else {},
        named={"tool": out},
        found=found,
    )  # fmt: skip


def _observe_by_camera(
    log: str, robot: str | None, camera: Path, more: bool, columns: Path | None, out: Path | None, options: RobotOptions,
    output: Output,
) -> Outcome:  # fmt: skip
    """Return the outcome of observe --camera."""
    if robot is None or more:
        raise InputError("bad_option", "--camera takes ROBOT, and neither --acceleration nor --kinematic")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.observers import CameraTrack, observe_by_camera
        from tau_dyn.kinematics import pick_columns
        from tau_dyn.log import read_log
        from tau_dyn.mechanism import forward_kinematics

        read, machine, table = read_log(log, columns), options.load(robot), read_columns(camera)
        names = [f"{axis}_tool" for axis in _AXES]
        rows = pick_columns(table, ["t", *names, *(f"{name}_stderr" for name in names)], str(camera))
        track = CameraTrack.of(rows[:, 0], rows[:, 1:4], rows[:, 4:], str(camera))
        poses = forward_kinematics(machine, read.joint("q", machine.actuated)).poses
        step("tracking")
        found = observe_by_camera(names, read.t, poses, track)
    return Outcome(
        result={"axes": to_plain(found.to_rows()), "filter": found.how, "frequency_scale": None},
        warnings=[*read.warnings, *found.warnings],
        inputs=[(log, read.sha256), camera, *([columns] if columns else []), *options.list_files(robot)],
        files={out: found.to_csv()} if out else {},
        named={"tool": out},
        found=found,
    )


def compute_shared_forces(
    model: Annotated[str, describe_robot_or_model("with more drives than freedoms")],
    /,
    *,
    motion: Annotated[Path, Parameter(metavar="MOTION.csv")],
    preload: Annotated[Finites, Parameter(metavar="P")] = (),
    width: Annotated[Positive, Parameter(metavar="V")] = 0.01,
    out: Annotated[Path, build_destination("FORCES.csv", "Write t and tau_ff_J of all drives here", csv=True)],
    robot_options: RobotOptions = RobotOptions(),
    output: Output = Output(),
) -> Outcome:
    """Forces of double motors and other redundant drives along a motion, with a preload that keeps gears free of backlash.

    Args:
        motion: The motion of the actuated joints, from plan-motion, excite or simulate
        preload: Preload of each redundant drive [N or N m] (default: a tenth above the smallest without backlash)
        width: Speed within which the sign of friction is smoothed [m/s or rad/s]
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control import compute_drive_forces
        from tau_dyn.simulate import Trajectory

        loaded = robot_options.load_model(model)
        wanted = Trajectory.from_csv(str(motion), loaded.robot.actuated)
        found = compute_drive_forces(loaded, wanted, preload, width=width)
    rows = found.to_rows()
    return Outcome(
        result={
            "drives": to_plain(rows), "preload": to_plain(found.preload), "smallest_preload": to_plain(found.smallest),
            "out": str(out),
        },
        warnings=[*loaded.robot.warnings, *found.warnings],
        inputs=[motion, *robot_options.list_files(model)],
        lines=[
            f"{row['joint']}: at most {row['force_max']:.4g} {row['unit']} of {row['force_limit']:.4g}, preload "
            f"{row['preload']:.4g}"
            for row in rows
        ] + [f"smallest preload without backlash {abs(found.smallest).max():.4g} {found.units[-1]} -> {out}"],
        files={out: found.to_csv()},
        named={"forces": out},
    )  # fmt: skip
