"""How far the tool may be from where it should be: stated or measured errors of actuators, rods and joints, over a section."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    get_robot_file,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.kinds import read_whole_between
from tau_dyn.exceptions import InputError

HELP = "how accurate a robot is; are its guideways straight and parallel"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    errors = parser.add_argument_group("what is wrong")
    errors.add_argument(
        "--actuator-error",
        metavar="SIZE",
        nargs="+",
        action="extend",
        default=[],
        help="bound on the actuators' errors in m (rad for turning joints): 50e-6 for all, JOINT=50e-6 in all directions, "
        "JOINT=50e-6:20e-6 along and across its guideway",
    )
    errors.add_argument("--errors", metavar="FILE.yaml", type=Path, help="errors of actuators, rods and rod joints")
    errors.add_argument(
        "--measured",
        metavar="[JOINT=]FILE.csv",
        nargs="+",
        action="extend",
        default=[],
        help="measured points: of one cart (q_J and x_tool..; name the joint where the file has several), to check and take "
        "its errors from; of the plate (all q_J and qx_tool..), to check its orientation; a joint's second file is another load",
    )
    where = parser.add_argument_group("where")
    where.add_argument(
        "--section",
        metavar="AXIS=VALUE",
        help="cut through the workspace, such as x=1.75; default at home; of one or two actuators their whole motion",
    )
    where.add_argument(
        "--range", metavar="AXIS=LOW:HIGH", nargs="+", action="extend", default=[], help="part of the section"
    )
    where.add_argument(
        "--grid",
        metavar="N",
        type=read_whole_between(2, 201),
        help="points along the section's longer side (31; 11 for slow ones)",
    )
    where.add_argument("--no-limits", action="store_true", help="ignore the actuators' position limits")
    where.add_argument("--poses", metavar="POSES.csv", type=Path, help="poses (q_J) instead of a section")
    how = parser.add_argument_group("how")
    how.add_argument(
        "--method",
        nargs="+",
        action="extend",
        default=[],
        metavar="METHOD",
        help="linear, parallelepiped, ellipsoid, exact, certified, montecarlo or all (default)",
    )
    how.add_argument(
        "--samples",
        metavar="N",
        type=read_whole_between(1, 100_000),
        help="random draws a pose (300; 50 for slow robots)",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Bound the tool's error."""
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.mechanism import get_rods

        robot = load_robot_from(args)
        rods = get_rods(robot)
        read, files = _measured(args, robot)
        errors, from_measured = _errors(args, robot, rods, read)
        found = (
            _checked_only(robot, read)
            if errors is None
            else _study(args, robot, rods, errors, read, from_measured, step)
        )
    return Outcome(
        result=found.to_dict(),
        warnings=[*robot.warnings, *(w for _, points in files for w in points.warnings), *_doubts(found)],
        inputs=[
            *get_robot_file(args),
            *([args.errors] if args.errors else []),
            *((name, p.sha256) for name, p in files),
            *([args.poses] if args.poses else []),
        ],  # fmt: skip
        show=lambda console: _show(console, found, args),
        report=lambda: _page(found, [(name, p.sha256) for name, p in files]),
    )


def _measured(args: argparse.Namespace, robot):
    """Return the checks of measured points, and the files."""
    from tau_dyn.kinematics.accuracy import Measured
    from tau_dyn.kinematics.assumptions import check_orientation, check_parallelism, fit_guideway, load_shift
    from tau_dyn.log import read_measured
    from tau_dyn.mechanism import convert_from_quaternions

    lines, loads, orientation, files = {}, [], None, []
    for text in args.measured:
        named, equals, path = text.partition("=")
        named, path = (named, path) if equals and named in robot.actuated else ("", text)
        points = read_measured(path, robot.actuated)
        files.append((path, points))
        if not named and points.quaternions is not None:
            if orientation is not None:
                raise InputError(
                    "bad_option", f"{points.name}: orientation was read from another file already; give one"
                )
            sliding = [
                k for k, j in enumerate(points.joints) if robot.joint_kinds[robot.actuated.index(j)] == "prismatic"
            ]
            if not sliding:
                raise InputError(
                    "unsupported", f"{points.name}: its orientation can be told apart only along sliding actuators"
                )
            if points.points is None:
                raise InputError(
                    "missing_column",
                    f"{points.name} lacks x_tool, y_tool, z_tool, which tell the layers of poses apart",
                )
            orientation = check_orientation(
                points.q[:, sliding], convert_from_quaternions(points.points, points.quaternions)
            )
            continue
        joint = named or _only(points, robot)
        if points.points is None:
            raise InputError(
                "missing_column", f"{points.name} lacks x_tool, y_tool, z_tool: where the cart was measured"
            )
        if robot.joint_kinds[robot.actuated.index(joint)] != "prismatic":
            raise InputError(
                "unsupported", f"{points.name}: {joint} turns; only a sliding joint has a guideway to check"
            )
        if joint in lines:
            loads.append(load_shift(lines[joint], points.column(joint), points.points))
        else:
            lines[joint] = fit_guideway(joint, points.column(joint), points.points)
    ordered = [lines[j] for j in robot.actuated if j in lines]
    return Measured(ordered, check_parallelism(ordered), loads, orientation), files


def _only(points, robot) -> str:
    if len(points.joints) > 1:
        several = ", ".join(points.joints)
        raise InputError(
            "bad_option",
            f"{points.name} has {several} but no orientation: say whose cart was measured, as {points.joints[0]}={points.name}",
        )
    return points.joints[0]


def _errors(args: argparse.Namespace, robot, rods, measured):
    """Return the errors, None for none at all, and whether they are from measurements."""
    from tau_dyn.kinematics.accuracy import ActuatorError, ErrorBounds, read_actuator_errors, read_errors_file

    given = ErrorBounds()
    if args.errors is not None:
        given = read_errors_file(args.errors, robot.actuated, () if rods is None else rods.names)
    stated = {**given.actuators, **read_actuator_errors(args.actuator_error, robot.actuated)}
    seen = {line.joint: ActuatorError(*line.bounds()) for line in measured.guideways if line.joint not in stated}
    errors = ErrorBounds({**stated, **seen}, given.rods)
    if not errors.actuators and not errors.rods:
        if not args.measured:
            raise InputError(
                "bad_option", "no error is given; say --actuator-error 50e-6, --errors FILE.yaml or --measured FILE.csv"
            )
        return None, False
    return errors, bool(seen)


def _checked_only(robot, measured):
    from tau_dyn.kinematics.accuracy import AccuracyResult

    return AccuracyResult(robot, None, None, None, (), measured)


def _study(args: argparse.Namespace, robot, rods, errors, measured, from_measured: bool, step):
    from tau_dyn.kinematics.accuracy import METHODS, study_accuracy
    from tau_dyn.mechanism import Poses

    step("poses")
    methods = list(
        dict.fromkeys(m for given in args.method or ["all"] for m in (METHODS if given == "all" else (given,)))
    )
    slow = rods is None and bool(robot.loops)  # loops in a tree are closed one step at a time
    args.grid, args.samples = args.grid or (11 if slow else 31), args.samples or (50 if slow else 300)
    grid, q, tool = _listed(args, robot) if args.poses else _gridded(args, robot)
    return study_accuracy(
        robot, errors, q, Poses(tool.position, tool.rotation), grid=grid, methods=methods, samples=args.samples,
        seed=args.seed, measured=measured, from_measured=from_measured, progress=step,
    )  # fmt: skip


def _listed(args: argparse.Namespace, robot):
    from tau_dyn.log import read_measured
    from tau_dyn.mechanism import forward_kinematics

    if args.section or args.range:
        raise InputError("bad_option", "--poses and --section are two ways to say where; give one")
    points = read_measured(args.poses, robot.actuated)
    missing = [j for j in robot.actuated if j not in points.joints]
    if missing:
        raise InputError("missing_column", f"{points.name} lacks q_{missing[0]}; a pose needs every actuated joint")
    found = forward_kinematics(robot, points.q)
    wrong = [k for k, ok in enumerate(found.ok) if not ok]
    if wrong:
        raise InputError(
            "unreachable",
            f"{points.name}: pose {wrong[0] + 1} of {len(points.q)} has no tool position: {found.reason[wrong[0]]}",
        )
    return None, points.q, found.poses


def _gridded(args: argparse.Namespace, robot):
    from tau_dyn.kinematics.accuracy import (
        choose_default_section,
        lay_default_grid,
        lay_grid,
        read_section,
        sample_default_motion,
    )
    from tau_dyn.mechanism import Poses

    limits, given = not args.no_limits, bool(args.section or args.range)
    if not given and (sampled := sample_default_motion(robot, args.grid)):
        return None, *sampled
    if given:
        section = read_section(args.section) if args.section else choose_default_section(robot)
        grid = lay_grid(robot, section.within(args.range), args.grid, limits=limits)
    else:
        grid = lay_default_grid(robot, args.grid, limits=limits)
    return grid, grid.q[grid.ok], Poses(grid.poses.position[grid.ok], grid.poses.rotation[grid.ok])


def _doubts(found) -> list[str]:
    lost = int(found.lost.sum())
    if not lost:
        return []
    return [
        f"at {lost} of {len(found.lost)} poses errors within the bounds can take the robot into a singularity; "
        "there is no largest error there"
    ]


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.report import print_accuracy

    print_accuracy(console, found, list_written_files(args))


def _page(found, files: list[tuple[str, str]]) -> str:
    from tau_dyn.report import build_accuracy_page

    return build_accuracy_page(found, files=files, command_line=format_command_line())
