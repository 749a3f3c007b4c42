"""`tau-dyn check`, `tau-dyn columns` and `tau-dyn simulate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter, validators

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome, describe_unanswered
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.message_codes import UNCODED, get_code

if TYPE_CHECKING:
    from tau_dyn.log import LogCheck


def check(
    log: str,
    robot: str | None = None,
    /,
    *,
    columns: args.ColumnMapFile = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """Check whether a log is usable: sampling, gaps, quantisation, saturation, excitation.

    Args:
        log: CSV, Parquet, MCAP, a ROS bag or .mat
        robot: The robot of the log; gives units and limits
    """
    with show_progress(output.quiet) as step:
        step("reading")
        from tau_dyn.legged import check_robot_log
        from tau_dyn.log import read_log

        machine = robot_options.load(robot, may_float=True) if robot else None
        read = read_log(log, columns)
        said: list[str] = []
        if machine is not None and robot is not None:
            known = set(machine.warnings)
            machine = robot_options.hold_silent_joints(machine, robot, [read])
            said = [sentence for sentence in machine.warnings if sentence not in known]

            from tau_dyn.identify import check_against_robot, complete_positions, is_diagnosis_invalid
            from tau_dyn.log import list_data_warnings

            (read,) = complete_positions(machine, [read])
        checked = check_robot_log(read, machine)
        if machine is not None and not machine.base_coordinates and read.has("tau", machine.actuated):
            step("comparing the log with the robot file")
            with_masses = any(link.nominal[0] > 0 for link in machine.links)
            is_compared = with_masses and not is_diagnosis_invalid(list_data_warnings(read, machine.driven))
            checked = checked.with_faults(check_against_robot(machine, [read]), is_compared)

    refusal = _name_faults(checked)
    return Outcome(
        result=checked.to_dict() | (describe_unanswered(refusal) if refusal else {}),
        warnings=[*read.warnings, *said, *(w for w in checked.warnings if get_code(w) != UNCODED)],
        inputs=[(log, read.sha256), columns, *(robot_options.list_files(robot) if robot else [])],
        found=checked,
        context={"log": read, "robot": machine},
        exit_status=refusal.exit_status if refusal else 0,
    )


def _name_faults(checked: LogCheck) -> CannotAnswer | None:
    """Return the faults of a log that is not usable, with their remedies; None for a usable log."""
    faults = [f for f in checked.findings if f.severity == "fault"]
    if not faults:
        return None
    remedies = dict.fromkeys(f.remedy or "Mend the log as the sentence states, or record it again." for f in faults)
    missing = f"a log without these faults: {' '.join(f.sentence for f in faults)}"
    return CannotAnswer("log_not_usable", missing, " ".join(remedies))


def columns(
    log: str,
    robot: args.RobotName,
    /,
    *,
    out: Annotated[Path | None, args.build_destination("MAP.yaml", "Write the map here")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Propose a column map for a foreign log, or for measured poses.

    Args:
        log: CSV, Parquet, MCAP, a ROS bag or .mat
    """
    with show_progress(output.quiet) as step:
        step("reading")
        from tau_dyn.calibrate import propose_pose_columns
        from tau_dyn.legged import propose_robot_columns

        machine = robot_options.load(robot, may_float=True)
        arm = robot_options.hold_silent_joints(machine, robot, [])
        proposal = propose_pose_columns(log, arm) or propose_robot_columns(log, machine)
        if arm is not machine and not any(
            key.startswith("q_") for key in proposal.entries
        ):  # a log without the gripper
            proposal = propose_robot_columns(log, arm)
    text = proposal.to_yaml()
    return Outcome(
        result=proposal.to_dict(),
        warnings=[*machine.warnings, *proposal.warnings],
        inputs=[(log, proposal.sha256), *robot_options.list_files(robot)],
        lines=[*(line for line in text.splitlines() if not line.startswith("#")), *proposal.template],
        files={out: text} if out else {},
        named={"map": out},
    )


DEFAULT_DURATION_S = 60.0
"""Default length of a named motion, and of a vibration test [s]."""
DEFAULT_BUS_HZ = 50.0
"""Default rate at which a servo's commands are sent and its positions logged [Hz]."""
_TRUTH = Group("True values in addition to ROBOT", validator=validators.MutuallyExclusive())
_SENSORS = Group("Controller and sensors")
_VIBRATION = Group("Vibration (robot files with springs, such as gantry_tau --set arms=complete --set flexible=true)")


@Parameter(name="*", group=_SENSORS)
@dataclass(frozen=True, kw_only=True)
class SensorOptions:
    """The simulated controller's and sensors' options.

    Attributes:
        rate: Control rate (default 1000)
        log_rate: Log rate, the control rate divided by a whole number
        force_noise: Standard deviation [N or N m]
        force_colour: AR(1) coefficient of the force noise
        encoder_noise: Standard deviation [m or rad]
        encoder_resolution: Resolution [m or rad]; 0 for no quantisation
        tool_noise: Tool position noise [m]
    """

    rate: Annotated[args.Positive | None, Parameter(metavar="HZ")] = None
    log_rate: Annotated[args.Positive | None, Parameter(metavar="HZ")] = None
    force_noise: Annotated[args.NotNegative, Parameter(metavar="N")] = 5.0
    force_colour: Annotated[float, Parameter(metavar="PHI", validator=args.FINITE)] = 0.0
    encoder_noise: Annotated[args.NotNegative, Parameter(metavar="M")] = 5e-6
    encoder_resolution: Annotated[args.NotNegative, Parameter(metavar="M")] = 0.0
    tool_noise: Annotated[args.NotNegative, Parameter(metavar="M")] = 0.0


@Parameter(name="*", group=_VIBRATION)
@dataclass(frozen=True, kw_only=True)
class VibrationOptions:
    """A vibration log instead of a motion.

    Attributes:
        vibration: Instead of a motion, near home: prbs, binary references at 250 Hz; or pushes on the tool at 1 kHz, -xyz
            in turn
        amplitude: Amplitude of the references [m or rad] (default 1e-3), or of a push [N s] (2)
        frame: Frame or link whose position is logged
        push_at: Frame or link that is pushed (default that of --frame)
        drive_lag: Time constant of the drives, one or one per joint [s] (default: no lag)
        drive_delay: Delay of the drives [s]
        acceleration_noise: Standard deviation [m/s^2]
    """

    vibration: Literal["prbs", "push-x", "push-y", "push-z", "push-xyz"] | None = None
    amplitude: Annotated[args.Positive | None, Parameter(metavar="A")] = None
    frame: Annotated[str, Parameter(metavar="NAME")] = "tool"
    push_at: Annotated[str | None, Parameter(metavar="NAME")] = None
    drive_lag: Annotated[args.Positives, Parameter(metavar="S")] = ()
    drive_delay: Annotated[args.NotNegative, Parameter(metavar="S")] = 0.0
    acceleration_noise: Annotated[args.NotNegative, Parameter(metavar="A")] = 0.07


def simulate(
    robot: Annotated[str, args.describe_robot_or_model("which carries its robot, its effects and their values")],
    /,
    *,
    motion: Annotated[str, Parameter(metavar="M")] = "fourier",
    duration: Annotated[args.Positive | None, Parameter(metavar="S")] = None,
    out: Annotated[Path, args.build_destination("LOG.csv", "Write the log here", csv=True)],
    effects: Annotated[Path | None, Parameter(group=_TRUTH, metavar="E.yaml")] = None,
    model: Annotated[Path | None, Parameter(group=_TRUTH, metavar="FILE")] = None,
    controller: Annotated[Path | None, Parameter(metavar="LAW.yaml")] = None,
    sensors: SensorOptions = SensorOptions(),
    vibration: VibrationOptions = VibrationOptions(),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """A log from the model, its controller and its sensors.

    Args:
        motion: fourier, slow, strokes, multisine, prbs, or a CSV with t and q_ref_JOINT
        duration: Length of a named motion [s] (default 60)
        effects: Effects and parameter values of the true robot
        model: Simulate ROBOT with the effects and values of this model file
        controller: The controller file; a servo's law gives a log of commands and positions (cmd_J, q_J) without torque
    """
    if vibration.vibration:
        for option, given in (("--effects", effects), ("--model", model), ("--log-rate", sensors.log_rate)):
            if given:
                raise InputError("bad_option", f"{option} does not go with --vibration")
        return _simulate_vibration(
            robot, robot_options, duration or DEFAULT_DURATION_S, sensors, vibration, out, output
        )
    if duration and Path(motion).suffix:
        raise InputError(
            "bad_option", f"--duration is the length of a named motion; {motion} has its own, so leave it out"
        )
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.render import SimulatedLog
        from tau_dyn.simulate import (
            CascadeController,
            Sensors,
            Trajectory,
            build_named_motion,
            read_law_file,
            simulate as simulate_model,
        )

        true = _build_true_model(robot, robot_options, effects, model)
        if Path(motion).suffix:
            path = Trajectory.from_csv(motion, true.robot.actuated)
        else:
            path = build_named_motion(motion, true, duration or DEFAULT_DURATION_S, output.seed)
        built = Sensors(
            encoder_noise=sensors.encoder_noise,
            encoder_resolution=sensors.encoder_resolution,
            force_noise=sensors.force_noise,
            force_ar=(sensors.force_colour,) if sensors.force_colour else (),
            tool_noise=sensors.tool_noise,
            log_rate_hz=sensors.log_rate,
        )
        log = _simulate_servo(true, path, controller, sensors, output.seed, out.name) or simulate_model(
            true,
            path,
            None
            if controller is None
            else CascadeController(read_law_file(controller, true.robot), start=true.steady()),
            sensors=built,
            seed=output.seed,
            rate_hz=sensors.rate or 1000.0,
            name=out.name,
            progress=lambda share: step(f"simulating {100 * share:.0f} %"),
        )
    said = f"{log.duration:.4g} s of {true.robot.name} at {log.rate_hz:g} Hz -> {out}"

    return Outcome(
        result={"n_samples": log.n_samples, "duration_s": log.duration, "rate_hz": log.rate_hz, "out": str(out)},
        warnings=[*true.robot.warnings, *log.warnings],
        inputs=[
            *robot_options.list_files(robot),
            *(p for p in (effects, model, controller, Path(motion)) if p is not None and p.is_file()),
        ],
        lines=[said],
        files={out: log.to_csv},
        printed=False,
        found=SimulatedLog(log, true, built, {"motion": motion, "seed": str(output.seed)}),
    )


def _simulate_servo(true, path, controller: Path | None, sensors: SensorOptions, seed: int, name: str):
    """Return a log of commands and positions if the controller file or the model file holds a servo's law, else None."""
    from tau_dyn.servo import simulate_loop_log
    from tau_dyn.simulate import build_servo_law, is_servo_law, read_servo_law

    if controller is not None and is_servo_law(controller):
        law = read_servo_law(controller, true.robot)
    elif controller is None and true.controller.get("law") == "servo":
        law = build_servo_law(dict(true.controller), true.robot, true.robot.source)
    else:
        return None
    return simulate_loop_log(
        true, law, path, rate_hz=sensors.log_rate or DEFAULT_BUS_HZ, encoder_noise=sensors.encoder_noise,
        encoder_resolution=sensors.encoder_resolution, seed=seed, name=name,
    )  # fmt: skip


def _build_true_model(robot: str, options: args.RobotOptions, effects: Path | None, model: Path | None):
    """Return the model to simulate: that of a model file, or ROBOT with hidden effects, with a model's values, or nominal."""
    from tau_dyn.identify import build_model
    from tau_dyn.model import Model
    from tau_dyn.simulate import read_effects_file

    if args.is_saved_model(robot):
        named = {"--set": options.set, "--actuated": options.actuated, "--effects": effects, "--model": model}
        given = [name for name, value in named.items() if value]
        if given:
            raise InputError(
                "bad_option",
                f"{robot} is a model file, which carries its own robot, effects and values; leave {given[0]} out, or "
                f"name the robot and give the file with --model",
            )
        return Model.load(robot)
    machine = options.load(robot)
    if effects:
        return read_effects_file(effects, machine)
    return build_model(machine, model) if model else Model.of(machine)


def _simulate_vibration(
    robot: str,
    options: args.RobotOptions,
    duration: float,
    sensors: SensorOptions,
    test: VibrationOptions,
    out: Path,
    output: args.Output,
) -> Outcome:
    """Simulate a vibration test."""
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.mechanism import FlexibleModel
        from tau_dyn.simulate import VibrationSensors, push_log, simulate_binary_log

        machine = options.load(robot)
        near = FlexibleModel(machine).at(tool=test.frame, pushed=test.push_at)
        step("simulating")
        built = VibrationSensors(sensors.encoder_noise, sensors.tool_noise, test.acceleration_noise)
        shared = {
            "duration": duration, "drives": _build_drives(near, test), "sensors": built, "seed": output.seed, "name": out.name,
        }  # fmt: skip
        if test.vibration == "prbs":
            amplitude, rate = test.amplitude or 1e-3, sensors.rate or 250.0
            log = simulate_binary_log(near, rate_hz=rate, amplitude=amplitude, **shared)
        else:
            directions = str(test.vibration).removeprefix("push-")
            shared["repeat"] = max(len(directions), round(duration / 5))
            log = push_log(near, directions, rate_hz=sensors.rate or 1000.0, impulse=test.amplitude or 2.0, **shared)
    frequencies = near.natural_frequencies()
    lowest = ", ".join(f"{f:.4g}" for f in frequencies[:4])
    said = f"{log.duration:.4g} s of {machine.name} near home at {log.rate_hz:g} Hz, lowest resonances {lowest} Hz -> {out}"
    return Outcome(
        result={
            "n_samples": log.n_samples,
            "duration_s": log.duration,
            "rate_hz": log.rate_hz,
            "out": str(out),
            "natural_frequencies_hz": frequencies,
        },
        warnings=[*machine.warnings, *log.warnings],
        inputs=options.list_files(robot),
        lines=[said],
        files={out: log.to_csv},
    )


def _build_drives(near, test: VibrationOptions):
    from tau_dyn.mechanism import PositionDrives

    if not test.drive_lag:
        if test.drive_delay:
            raise InputError("bad_option", "--drive-delay needs --drive-lag")
        return None
    lags = test.drive_lag * near.na if len(test.drive_lag) == 1 else test.drive_lag
    return PositionDrives(tuple(lags), test.drive_delay)
