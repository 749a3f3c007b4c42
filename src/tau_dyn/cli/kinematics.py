"""`tau-dyn fk` and `tau-dyn ik`: numbers on the command line or tables of poses, and one table out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

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
    """Where actuated positions put the tool.

    Args:
        q: Actuated positions [m or rad], in their order
        all: Every assembly mode found, with the count: proved in closed form or by a certificate, else found from many
            starts
        poses: A table of positions q_<joint>, one a row
    """
    import numpy as np

    if bool(q) == (poses is not None):
        raise InputError("bad_option", "give --q VALUE ... or --poses POSES.csv")
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.kinematics import build_forward_table, read_positions

        machine = robot_options.load(robot)
        if q and len(q) != machine.na:  # values of the joints that carry the tool will do: a gripper's do not move it
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
    """Which actuated positions put the tool at a pose.

    Args:
        position: Of the tool [m]
        quaternion: Of the tool; by default home's
        all: All configurations, also outside joint limits; the count is proved in closed form or by elimination, or only
            found
        poses: A table of poses x_tool y_tool z_tool [qx_tool qy_tool qz_tool qw_tool], one a row
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
