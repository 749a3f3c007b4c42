"""`tau-dyn fk` and `tau-dyn ik`: input as numbers on the command line or tables of poses, output as one table.

`tau-dyn workspace`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter, Token

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError


def fk(
    robot: args.RobotName,
    /,
    *,
    q: Annotated[args.Finites, Parameter(metavar="VALUE")] = (),
    all: bool = False,
    poses: Annotated[Path | None, Parameter(metavar="POSES.csv")] = None,
    out: args.TABLE_OUT = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Tool pose at given actuated positions (forward kinematics).

    Args:
        q: Actuated positions [m or rad], in their order
        all: Every assembly mode found; their number is proved in closed form or by a certificate, else found from many starts
        poses: A table of positions q_<joint>, one per row
    """
    import numpy as np

    if bool(q) == (poses is not None):
        raise InputError("bad_option", "give --q VALUE ... or --poses POSES.csv")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.kinematics import build_forward_table, read_positions

        machine = robot_options.load(robot)
        if q and len(q) != machine.na:  # values of the joints that carry the tool suffice: a gripper's do not move it
            carrying = robot_options.hold_silent_joints(machine, robot, [])
            machine = carrying if len(q) == carrying.na else machine
        if q and len(q) != machine.na:
            named = ", ".join(machine.actuated)
            raise InputError("bad_option", f"--q: one value for each actuated joint ({named}), not {len(q)}")
        positions = np.array([q]) if poses is None else read_positions(args.read_columns(poses), machine, str(poses))
        step("closing the rods")
        table = build_forward_table(machine, positions, all_modes=all, progress=step)
    return _build_outcome(table, robot_options.list_files(robot), poses, out)


def ik(
    robot: args.RobotName,
    /,
    *,
    position: args.Place | None = None,
    quaternion: Annotated[
        tuple[float, float, float, float] | None, Parameter(validator=args.FINITE, metavar="X Y Z W")
    ] = None,
    all: bool = False,
    poses: Annotated[Path | None, Parameter(metavar="POSES.csv")] = None,
    out: args.TABLE_OUT = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Actuated positions at a given tool pose (inverse kinematics).

    Args:
        position: Position of the tool [m]
        quaternion: Orientation of the tool (default: at home)
        all: All configurations, including those outside joint limits; their number is proved in closed form or by
            elimination, else found from many starts
        poses: A table of poses x_tool y_tool z_tool [qx_tool qy_tool qz_tool qw_tool], one per row
    """
    import numpy as np

    if (position is None) == (poses is None):
        raise InputError("bad_option", "give --position X Y Z or --poses POSES.csv")
    if quaternion is not None and position is None:
        raise InputError("bad_option", "--quaternion goes with --position; a table has its own columns qx_tool ..")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.kinematics import build_inverse_table, place_home_orientation, read_poses
        from tau_dyn.mechanism import convert_from_quaternions

        machine = robot_options.load(robot)
        if poses is not None:
            wanted = read_poses(args.read_columns(poses), machine, str(poses))
        elif quaternion is not None:
            wanted = convert_from_quaternions(np.array([position]), np.array([quaternion]))
        else:
            wanted = place_home_orientation(machine, np.array([position]))
        step("solving")
        table = build_inverse_table(machine, wanted, all_configurations=all)
    return _build_outcome(table, robot_options.list_files(robot), poses, out)


def _build_outcome(table, robot_files: list[Path], poses: Path | None, out: Path | None) -> Outcome:
    return Outcome(
        result=table.to_dict(),
        warnings=[*table.robot.warnings, *table.warnings],
        inputs=[*robot_files, poses],
        files={out: table.to_csv()} if out else {},
        named={"table": out},
        found=table,
    )


_PLACES = Group("Poses and quantities")
_DEMANDS = Group("Conditions of a pose")
_SPRINGS = Group("What gives way")


def _read_stiffness(text: str) -> float:
    """Return a stiffness, infinity for `rigid`.

    Raises:
        ValueError: The text is not a number above zero.
    """
    if text == "rigid":
        return float("inf")
    try:
        value = float(text)
        args.POSITIVE_LARGE(None, value)
    except ValueError:
        raise ValueError("write a number above zero or 'rigid'") from None
    return value


def _convert_stiffness(_: Any, tokens: Sequence[Token]) -> float:
    return _read_stiffness(tokens[0].value)


def workspace(
    robot: args.RobotName,
    /,
    *,
    resolution: Annotated[args.Positive | None, Parameter(group=_PLACES, metavar="M")] = None,
    orientation: Annotated[
        tuple[float, float, float] | None, Parameter(group=_PLACES, validator=args.FINITE, metavar="ROLL PITCH YAW")
    ] = None,
    section: Annotated[tuple[str, ...], Parameter(group=_PLACES, metavar="AXIS=M")] = (),
    what: Annotated[args.Strings, Parameter(name=["--what", "--map"], group=_PLACES, metavar="NAME")] = (),
    tilt: Annotated[args.Place | None, Parameter(group=_PLACES)] = None,
    obstacles: Annotated[Path | None, Parameter(group=_DEMANDS, metavar="FILE.yaml")] = None,
    tool_limit: Annotated[tuple[str, ...], Parameter(group=_DEMANDS, metavar="AXIS=LO:HI")] = (),
    ball_angle: Annotated[args.Positive | None, Parameter(group=_DEMANDS, metavar="DEG")] = None,
    clearance: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="M")] = 0.0,
    no_collisions: Annotated[bool, Parameter(group=_DEMANDS)] = False,
    condition: Annotated[args.Positive, Parameter(group=_DEMANDS, metavar="N")] = 1000.0,
    border: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="M")] = 0.0,
    rod_stiffness: Annotated[
        float | None, Parameter(group=_SPRINGS, metavar="N/M", converter=_convert_stiffness)
    ] = None,
    actuator_stiffness: Annotated[args.Strings, Parameter(group=_SPRINGS, metavar="[JOINT=]VALUE")] = (),
    load: Annotated[args.NotNegative | None, Parameter(group=_SPRINGS, metavar="N")] = None,
    out: Annotated[
        Path | None, args.build_destination("POINTS.csv", "Write the judged points with their reasons here", csv=True)
    ] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Workspace of a robot's tool, reasons for unreachable points, and stiffness, speed and distance to singularities in it.

    Args:
        resolution: Finest grid [m]; default a 60th of the workspace
        orientation: Rotation of the tool from home [deg]
        section: Plane to check and draw; default: through home
        what: Maps of sections and --out: condition, manipulability, singularity, speed, force, stiffness, sag, resonance
        tilt: Position [m] at which the range of tilt is computed; default home
        obstacles: Obstacles, safety zones, limits of the tool
        tool_limit: Limits of the tool [m]
        ball_angle: Largest angle of all ball joints; default the file's, else 45
        clearance: Clearance between the robot's own parts
        no_collisions: Ignore collisions of the robot with itself
        condition: Largest condition number
        border: Distance to keep from the border
        rod_stiffness: Stiffness of each rod with its joints, or 'rigid' (default: the file's)
        actuator_stiffness: N/m or N m/rad between drive and link, or 'rigid' (default: the file's)
        load: Weight of a load at the tool, for the sag
    """
    with show_progress(output.quiet) as step:
        step("loading")
        import numpy as np

        from tau_dyn.kinematics import Surroundings, add_limits, read_surroundings
        from tau_dyn.kinematics.workspace import PoseRequirements, build_points_table, study_workspace

        machine = robot_options.load(robot)
        around = read_surroundings(obstacles) if obstacles else Surroundings()
        demands = PoseRequirements(
            ball_angle=None if ball_angle is None else float(np.deg2rad(ball_angle)),
            surroundings=add_limits(around, list(tool_limit)),
            collisions=not no_collisions,
            clearance=clearance,
            condition=condition,
            border=border,
        )
        found = study_workspace(
            machine,
            demands=demands,
            resolution=resolution,
            turn_deg=orientation,
            sections=list(section),
            maps=list(what),
            tilt_at=tilt,
            rod_stiffness=rod_stiffness,
            actuator_stiffness=_read_stiffnesses(actuator_stiffness),
            load=load,
            seed=output.seed,
            progress=step,
        )

    def save(path: Path) -> None:
        build_points_table(found).to_csv(path, index=False, float_format="%.9g")

    return Outcome(
        result=found.to_dict(),
        warnings=[*machine.warnings, *found.warnings],
        inputs=[*robot_options.list_files(robot), obstacles],
        files={out: save},
        named={"points": out},
        found=found,
    )


def _read_stiffnesses(given: tuple[str, ...]) -> dict[str, float]:
    found = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            found[name] = _read_stiffness(number)
        except ValueError as fault:
            raise InputError("bad_option", f"--actuator-stiffness {text!r}: {fault}, or JOINT=number") from None
    return found
