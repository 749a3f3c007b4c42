"""`tau-dyn accuracy`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_ERRORS = Group("Errors")
_PLACES = Group("Where")
_METHODS = Group("How")


@Parameter(name="*", group=_PLACES)
@dataclass(frozen=True, kw_only=True)
class PlaceOptions:
    """The poses at which the accuracy is computed.

    Attributes:
        section: Section through the workspace, such as x=1.75; default at home; with one or two actuators their whole motion
        range: Part of the section
        grid: Points along the section's longer side (31; 11 for slow ones)
        no_limits: Ignore the actuators' position limits
        poses: Poses (q_J) instead of a section
    """

    section: Annotated[str | None, Parameter(metavar="AXIS=VALUE")] = None
    range: Annotated[args.Strings, Parameter(metavar="AXIS=LOW:HIGH")] = ()
    grid: Annotated[
        int | None, Parameter(metavar="N", validator=args.build_whole_kind(2, 201), converter=args.read_whole)
    ] = None
    no_limits: bool = False
    poses: Annotated[Path | None, Parameter(metavar="POSES.csv")] = None


def accuracy(
    robot: args.RobotName,
    /,
    *,
    actuator_error: Annotated[args.Strings, Parameter(group=_ERRORS, metavar="SIZE")] = (),
    errors: Annotated[Path | None, Parameter(group=_ERRORS, metavar="FILE.yaml")] = None,
    measured: Annotated[args.Strings, Parameter(group=_ERRORS, metavar="[JOINT=]FILE.csv")] = (),
    places: PlaceOptions = PlaceOptions(),
    method: Annotated[args.Strings, Parameter(group=_METHODS, metavar="METHOD")] = (),
    samples: Annotated[
        int | None,
        Parameter(group=_METHODS, metavar="N", validator=args.build_whole_kind(1, 100000), converter=args.read_whole),
    ] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """Bounds on the tool's error from stated or measured errors of actuators and rods, over a section.

    Args:
        actuator_error: Bound on the actuators' errors in m (rad for revolute joints): 50e-6 for all, JOINT=50e-6 in all
            directions, JOINT=50e-6:20e-6 along and across its guideway
        errors: Errors of actuators, rods and rod joints
        measured: Measured points of one cart (q_J and x_tool..; name the joint if the file has several), to check and take its
            errors from; or of the plate (all q_J and qx_tool..), to check its orientation; a joint's second file is another
            load
        method: linear, parallelepiped, ellipsoid, exact, certified, montecarlo or all (default)
        samples: Random draws per pose (300; 50 for slow robots)
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.kinematics.accuracy import AccuracyResult
        from tau_dyn.mechanism import get_rods

        machine = robot_options.load(robot)
        rods = get_rods(machine)
        read, files = read_measured_files(measured, machine)
        bounds, from_measured = _collect_errors(errors, actuator_error, machine, rods, read)
        if bounds is None:
            found = AccuracyResult(machine, None, None, None, (), read)
        else:
            study = _Study(places, method, samples, output.seed)
            found = study.run(machine, rods, bounds, read, from_measured, step)
    hashes = [(name, points.sha256) for name, points in files]

    return Outcome(
        result=found.to_dict(),
        warnings=[*machine.warnings, *(w for _, points in files for w in points.warnings), *_list_lost_poses(found)],
        inputs=[*robot_options.list_files(robot), errors, *hashes, places.poses],
        found=found,
        context={"files": hashes},
    )


def read_measured_files(given: tuple[str, ...], robot):
    """Return the checks of measured points, and the files."""
    from tau_dyn.kinematics.accuracy import Measured
    from tau_dyn.kinematics.assumptions import check_orientation, check_parallelism, fit_guideway, load_shift
    from tau_dyn.log import read_measured
    from tau_dyn.mechanism import convert_from_quaternions

    lines, loads, orientation, files = {}, [], None, []
    for text in given:
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
                    "unsupported", f"{points.name}: its orientation can be separated only along sliding actuators"
                )
            if points.points is None:
                raise InputError(
                    "missing_column",
                    f"{points.name} lacks x_tool, y_tool, z_tool, which separate the layers of poses",
                )
            orientation = check_orientation(
                points.q[:, sliding], convert_from_quaternions(points.points, points.quaternions)
            )
            continue
        joint = named or _get_only_joint(points, robot)
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


def _get_only_joint(points, robot) -> str:
    if len(points.joints) > 1:
        several = ", ".join(points.joints)
        raise InputError(
            "bad_option",
            f"{points.name} has {several} but no orientation: name the measured cart, as {points.joints[0]}={points.name}",
        )
    return points.joints[0]


def _collect_errors(path: Path | None, sizes: tuple[str, ...], robot, rods, measured):
    """Return the errors, or None, and whether they are from measurements."""
    from tau_dyn.kinematics.accuracy import ActuatorError, ErrorBounds, read_actuator_errors, read_errors_file

    given = ErrorBounds()
    if path is not None:
        given = read_errors_file(path, robot.actuated, () if rods is None else rods.names)
    stated = {**given.actuators, **read_actuator_errors(list(sizes), robot.actuated)}
    seen = {line.joint: ActuatorError(*line.bounds()) for line in measured.guideways if line.joint not in stated}
    errors = ErrorBounds({**stated, **seen}, given.rods)
    if not errors.actuators and not errors.rods:
        if not (measured.guideways or measured.loads or measured.orientation):
            raise InputError(
                "bad_option",
                "no error is given; give --actuator-error 50e-6, --errors FILE.yaml or --measured FILE.csv",
            )
        return None, False
    return errors, bool(seen)


@dataclass(frozen=True)
class _Study:
    """The requested study: section or poses, methods, number of draws."""

    places: PlaceOptions
    method: tuple[str, ...]
    samples: int | None
    seed: int

    def run(self, robot, rods, errors, measured, from_measured: bool, step: Callable[[str], None]):
        """Bound the tool's error."""
        from tau_dyn.kinematics.accuracy import METHODS, study_accuracy
        from tau_dyn.mechanism import Poses

        step("poses")
        chosen = self.method or ("all",)
        methods = list(dict.fromkeys(m for given in chosen for m in (METHODS if given == "all" else (given,))))
        slow = rods is None and bool(robot.loops)  # loops in a tree are closed one step at a time
        points, samples = self.places.grid or (11 if slow else 31), self.samples or (50 if slow else 300)
        listed = self.places.poses is not None
        grid, q, tool = _read_poses(self.places, robot) if listed else _lay_poses(self.places, points, robot)
        return study_accuracy(
            robot, errors, q, Poses(tool.position, tool.rotation), grid=grid, methods=methods, samples=samples,
            seed=self.seed, measured=measured, from_measured=from_measured, progress=step,
        )  # fmt: skip


def _read_poses(places: PlaceOptions, robot):
    from tau_dyn.log import read_measured
    from tau_dyn.mechanism import forward_kinematics

    if places.section or places.range:
        raise InputError("bad_option", "--poses and --section both choose the poses; give one")
    points = read_measured(str(places.poses), robot.actuated)
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


def _lay_poses(places: PlaceOptions, points: int, robot):
    from tau_dyn.kinematics.accuracy import (
        choose_default_section,
        lay_default_grid,
        lay_grid,
        read_section,
        sample_default_motion,
    )
    from tau_dyn.mechanism import Poses

    limits, given = not places.no_limits, bool(places.section or places.range)
    if not given and (sampled := sample_default_motion(robot, points)):
        return None, *sampled
    if given:
        section = read_section(places.section) if places.section else choose_default_section(robot)
        grid = lay_grid(robot, section.within(list(places.range)), points, limits=limits)
    else:
        grid = lay_default_grid(robot, points, limits=limits)
    return grid, grid.q[grid.ok], Poses(grid.poses.position[grid.ok], grid.poses.rotation[grid.ok])


def _list_lost_poses(found) -> list[str]:
    lost = int(found.lost.sum())
    if not lost:
        return []
    return [
        f"at {lost} of {len(found.lost)} poses errors within the bounds can take the robot into a singularity; "
        "there is no largest error there"
    ]
