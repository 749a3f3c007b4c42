"""`tau-dyn plan-motion` and `plan-poses`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter, Token, validators

from tau_dyn.cli import arguments as args
from tau_dyn.cli.calibrate import Frames
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_COLUMNS = ("x_tool", "y_tool", "z_tool")
_ENDS = Group("Where")
_LIMITS = Group("Limits, one or one a joint")


@Parameter(name="*", group=_ENDS)
@dataclass(frozen=True, kw_only=True)
class Ends:
    """Start, end and path of a motion.

    Attributes:
        start: Tool position at the start [m]
        end: Tool position at the end [m]
        start_joints: Actuated positions instead of --from [m or rad]
        end_joints: Actuated positions instead of --to [m or rad]
        path: line: a straight line of the tool; a table with x_tool, y_tool, z_tool: a spline through these points (default:
            free)
    """

    start: Annotated[args.Place | None, Parameter(name="--from")] = None
    end: Annotated[args.Place | None, Parameter(name="--to")] = None
    start_joints: Annotated[args.Finites, Parameter(name="--from-joints", metavar="Q")] = ()
    end_joints: Annotated[args.Finites, Parameter(name="--to-joints", metavar="Q")] = ()
    path: Annotated[str | None, Parameter(metavar="line|POINTS.csv")] = None

    def choose(self):
        """Return start, end and whether they are actuated positions.

        Raises:
            InputError: Start or end is given twice, or not at all.
        """
        import numpy as np

        if self.start and self.end and not (self.start_joints or self.end_joints):
            return np.array(self.start), np.array(self.end), False
        if self.start_joints and self.end_joints and not (self.start or self.end):
            return np.array(self.start_joints), np.array(self.end_joints), True
        raise InputError(
            "bad_option",
            "give the start and the end of the motion: --from X Y Z --to X Y Z, or --from-joints and --to-joints",
        )

    def read_path(self):
        """Return None, 'line', or the points of a table (n, 3) [m].

        Raises:
            InputError: The table or one of its columns is missing.
        """
        from tau_dyn.kinematics import pick_columns

        if self.path in (None, "line"):
            return self.path
        if not Path(self.path).is_file():
            raise InputError(
                "bad_option", f"--path {self.path}: write line, or name a table with the columns {', '.join(_COLUMNS)}"
            )
        table = args.read_columns(Path(self.path))
        missing = [name for name in _COLUMNS if name not in table]
        if missing:
            raise InputError(
                "missing_column", f"{self.path}: there is no column {missing[0]}; a path has {', '.join(_COLUMNS)} [m]"
            )
        return pick_columns(table, list(_COLUMNS), self.path)


@Parameter(name="*", group=_LIMITS)
@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Limits of a motion.

    Attributes:
        force_limit: Largest force [N or N m] (default the robot file's)
        speed_limit: Largest speed [m/s or rad/s] (default the robot file's)
        acceleration_limit: Largest acceleration [m/s^2 or rad/s^2] (default: no limit)
        jerk_limit: Largest jerk [m/s^3 or rad/s^3] (default: no limit)
        margin: Share of the forces that is kept for the feedback
        condition: Largest condition number of the loops
    """

    force_limit: Annotated[args.Positives | None, Parameter(metavar="L")] = None
    speed_limit: Annotated[args.Positives | None, Parameter(metavar="L")] = None
    acceleration_limit: Annotated[args.Positives | None, Parameter(metavar="L")] = None
    jerk_limit: Annotated[args.Positives | None, Parameter(metavar="L")] = None
    margin: Annotated[args.NotNegative, Parameter(metavar="SHARE")] = 0.0
    condition: Annotated[args.Positive | None, Parameter(metavar="C")] = None


def plan_motion(
    robot: Annotated[str, args.describe_robot_or_model("whose friction then counts")],
    /,
    *,
    ends: Ends = Ends(),
    limits: LimitOptions = LimitOptions(),
    energy_weight: Annotated[args.NotNegative, Parameter(metavar="W")] = 0.0,
    rate: Annotated[args.Positive, Parameter(metavar="HZ")] = 1000.0,
    nodes: Annotated[args.Whole, Parameter(metavar="N")] = 80,
    period: Annotated[args.Positive, Parameter(metavar="S")] = 0.004,
    out: Annotated[Path, args.build_destination("MOTION.csv", "Write t, q_ref, v_ref, a_ref here", csv=True)],
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """The fastest motion between two positions that the drives can follow, or one with less effort; free or along a path.

    Args:
        energy_weight: Minimise T + W times the integral of squared forces [s per N^2 s] (0: the shortest time)
        rate: Sample rate of the motion
        nodes: Intervals of linear acceleration
        period: Period of the controller; no interval is shorter
    """
    start, end, joints = ends.choose()
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.motion import MotionLimits, plan_motion as plan

        model = robot_options.load_model(robot)
        given = {name: getattr(limits, f"{name}_limit") for name in ("force", "speed", "acceleration", "jerk")}
        bounds = MotionLimits.of(model, margin=limits.margin, condition=limits.condition, **given)
        step("optimising")
        found = plan(
            model, start, end, limits=bounds, energy_weight=energy_weight, path=ends.read_path(), joints=joints,
            dt=1 / rate, nodes=nodes, period=period,
        )  # fmt: skip

    return Outcome(
        result=found.to_dict() | {"out": str(out)},
        warnings=[*model.robot.warnings, *found.warnings],
        inputs=[*robot_options.list_files(robot), *([Path(ends.path)] if ends.path not in (None, "line") else [])],
        files={out: found.to_csv},
        named={"motion": out},
        found=found,
    )


_DEVICE = Group(
    "What measures (default: everything seen with 0.1 mm and 0.1 mrad)", validator=validators.MutuallyExclusive()
)
_DEMANDS = Group("Where the robot may go")
_PICTURES = Group("Setting the camera up")
_DIGITS = 4  # decimals of the positions in an image, which a person types
Count = int | Literal["auto"]


def _read_count(_: Any, tokens: Sequence[Token]) -> Count:
    """Read a number of poses, or auto.

    Raises:
        ValueError: The text is neither.
    """
    text = tokens[0].value
    try:
        value = "auto" if text == "auto" else int(text)
        args.POSITIVE_WHOLE(None, value)
    except ValueError:
        raise ValueError(f"write {args.POSITIVE_WHOLE.words}, or auto") from None
    return value


@Parameter(name="*", group=_PICTURES)
@dataclass(frozen=True, kw_only=True)
class CameraSetup:
    """Placement of a camera, and images for its alignment.

    Attributes:
        save_camera: Write the camera's file with the chosen placement here; `choose` in it lists the free quantities
        picture: Write the expected camera image here, as lines to overlay on the live image
        at: Actuated positions of the robot in the image (default: the chosen pose that best determines the placement)
        taken: An image that the camera took at these positions; reports the correction of the camera, without a plan
    """

    save_camera: Annotated[Path | None, Parameter(metavar="CAMERA.yaml")] = None
    picture: Annotated[Path | None, Parameter(metavar="FILE.png")] = None
    at: Annotated[args.Finites, Parameter(metavar="Q")] = ()
    taken: Annotated[Path | None, Parameter(metavar="IMAGE")] = None

    def check(self, camera: Path | None) -> None:
        """Reject options that cannot be combined.

        Raises:
            InputError: There is no camera, or the positions of an image are missing.
        """
        given = {"--save-camera": self.save_camera, "--picture": self.picture, "--taken": self.taken, "--at": self.at}
        named = next((name for name, value in given.items() if value), None)
        if named and camera is None:
            raise InputError("bad_option", f"{named} needs a camera: give --camera FILE.yaml")
        if self.picture is not None and self.picture.suffix != ".png":
            raise InputError("bad_option", f"--picture {self.picture}: a picture's name ends in .png")
        if self.taken is not None and not self.at:
            raise InputError("bad_option", "--taken needs --at, the actuated positions at which the picture was taken")
        if self.at and not (self.picture or self.taken):
            raise InputError("bad_option", "--at belongs to a picture: give --picture or --taken as well")

    def require_plan(self, resume: Path) -> None:
        """Reject outputs of a new plan if a progress file exists.

        Raises:
            InputError: An image or a camera placement is requested.
        """
        if self.picture or self.save_camera:
            raise InputError(
                "bad_option",
                f"{resume} exists, so no poses are planned; leave out --resume, or --picture and --save-camera",
            )

    def check_device(self, device: Any) -> None:
        """Reject the output of a placement for a fixed camera, or of an image for a camera on the tool.

        Raises:
            InputError: One of these is requested.
        """
        from tau_dyn.calibrate.poses import ToolCamera

        if isinstance(device, ToolCamera) and (self.picture or self.taken or self.save_camera):
            raise InputError(
                "bad_option",
                "--picture, --taken and --save-camera are for a fixed camera; this one is on the tool",
            )
        if self.save_camera is not None and device.places is None:
            raise InputError(
                "bad_option",
                "--save-camera writes a chosen place; list the choices under `choose` in the camera's file",
            )

    def read_positions(self, robot):
        """Return actuated positions (na,); an empty array if they are not given.

        Raises:
            InputError: Their number differs from the robot's.
        """
        import numpy as np

        if self.at and len(self.at) != robot.na:
            raise InputError(
                "bad_option",
                f"--at has {len(self.at)} positions; the robot has {robot.na}: {', '.join(robot.actuated)}",
            )
        return np.array(self.at)


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
    fixtures: Annotated[Path | None, Parameter(group=_DEVICE, metavar="FILE.yaml")] = None,
    obstacles: Annotated[Path | None, Parameter(group=_DEMANDS, metavar="FILE.yaml")] = None,
    no_collisions: Annotated[bool, Parameter(group=_DEMANDS)] = False,
    safety: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="M")] = 0.05,
    safety_angle: Annotated[args.NotNegative, Parameter(group=_DEMANDS, metavar="DEG")] = 5.0,
    candidates: Annotated[
        int, Parameter(group=_DEMANDS, metavar="N", validator=args.POSITIVE_WHOLE, converter=args.read_whole)
    ] = 1000,
    out: Annotated[
        Path | None, args.build_destination("POSES.csv", "Write the places in driving order here: pose, q_J", csv=True)
    ] = None,
    rapid: Annotated[Path | None, Parameter(metavar="FILE.mod")] = None,
    resume: Annotated[Path | None, Parameter(metavar="FILE.json")] = None,
    setup: CameraSetup = CameraSetup(),
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Poses to measure for a calibration, their order, and the predicted accuracy.

    Args:
        n: Number of poses; auto: until more poses give little improvement
        model: Model to be calibrated, as in `calibrate --model` (default: all dimensions)
        criterion: Criterion for poses (tool: the tool's predicted variance over the workspace)
        accuracy: Required accuracy, rms over the workspace [m]; an error if it is not met
        known: Known frames
        weighted: The fit will weight each pose by the device's covariance
        camera: Camera and pattern
        tracker: Laser tracker and reflector
        fixtures: Points from which distances are measured; holes, planes and balls that the target touches
        obstacles: Obstacles, safety zones, limits of the tool
        no_collisions: Ignore collisions of the robot with itself
        safety: Distance from obstacles and the workspace's border [m]
        safety_angle: Distance from the ball joints' limits
        candidates: Approximate number of candidate poses
        rapid: Write a RAPID module here
        resume: Progress file: written if it does not exist; otherwise no new poses are chosen, and --out and --rapid get
            the remaining ones
    """
    import numpy as np

    setup.check(camera)
    if setup.taken is not None:
        return _align(robot, robot_options, camera, setup)
    demands = _build_demands(obstacles, no_collisions)
    if resume is not None and resume.exists():
        setup.require_plan(resume)
        return _go_on(robot, robot_options, resume, demands, out, rapid)
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.calibrate.poses import Safety, plan_campaign, read_camera, read_fixtures, read_tracker

        machine = robot_options.hold_silent_joints(robot_options.load(robot), robot, [])
        readers = ((camera, read_camera), (tracker, read_tracker), (fixtures, read_fixtures))
        device = next((read(path) for path, read in readers if path is not None), None)
        setup.check_device(device)
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
    if camera is not None and setup.save_camera is not None and plan.placement is not None:
        files[setup.save_camera] = plan.placement.format_file(camera)
    shown, lines = {}, []
    if setup.picture is not None:
        shown, line, files[setup.picture] = _draw_wanted(machine, plan, setup)
        lines.append(line)

    return Outcome(
        result=plan.to_dict() | shown,
        lines=lines,
        warnings=[*machine.warnings, *plan.warnings],
        inputs=[*robot_options.list_files(robot), camera, tracker, fixtures, obstacles],
        found=plan,
        files=files,
        named={
            "places": out,
            "RAPID": rapid,
            "progress": resume,
            "camera": setup.save_camera,
            "picture": setup.picture,
        },
    )


def _draw_wanted(machine, plan, setup: CameraSetup) -> tuple[dict[str, Any], str, Any]:
    """Return the pose of the expected camera image, for the result and in words, and the function that writes the image."""
    import numpy as np

    from tau_dyn.calibrate.poses import choose_picture_pose
    from tau_dyn.render import draw_camera_picture

    q = setup.read_positions(machine)
    if not len(q):
        tool = plan.tool(plan.choice.q)
        q = np.round(plan.choice.q[choose_picture_pose(plan.device, tool)], _DIGITS)
    model = plan.check.machine
    png = draw_camera_picture(plan.device, model, q, _place_tool(model, q))
    at = " ".join(f"{x:g}" for x in q)
    line = f"{', '.join(machine.actuated)} in the picture: --at {at}"
    return {"picture": {"at": q}}, line, lambda path: path.write_bytes(png)


def _place_tool(machine, q):
    """Return the tool's pose (1) at actuated positions (na,).

    Raises:
        InputError: The robot cannot reach these positions.
    """
    found = machine.kinematics.forward(q[None])
    if not found.ok.all():
        raise InputError("unreachable", f"--at: the robot's loops do not close at {' '.join(f'{x:g}' for x in q)}")
    return found.poses


def _align(robot: str, options: args.RobotOptions, camera: Path | None, setup: CameraSetup) -> Outcome:
    """Compare an image that the camera took with the expected one."""
    from tau_dyn.calibrate.poses import find_camera_correction, read_camera
    from tau_dyn.kinematics.workspace import build_machine
    from tau_dyn.render import draw_camera_picture
    from tau_dyn.vision import read_image

    assert camera is not None and setup.taken is not None
    machine, wanted = options.hold_silent_joints(options.load(robot), robot, []), read_camera(camera)
    setup.check_device(wanted)
    if wanted.places is not None:
        raise InputError(
            "bad_option",
            f"{camera}: `choose` leaves the place open; give the file written by --save-camera with --taken",
        )
    q = setup.read_positions(machine)
    model = build_machine(machine)
    tool = _place_tool(model, q)
    found = find_camera_correction(wanted, tool, setup.taken)
    files: dict[Path, Any] = {}
    if setup.picture is not None:
        png = draw_camera_picture(wanted, model, q, tool, taken=read_image(setup.taken), found=found.target)
        files[setup.picture] = lambda path: path.write_bytes(png)
    return Outcome(
        result={"at": q, "correction": found.to_dict()},
        warnings=[*machine.warnings, *found.warnings],
        inputs=[*options.list_files(robot), camera, setup.taken],
        lines=found.describe(),
        files=files,
        named={"picture": setup.picture},
    )


def _go_on(
    robot: str, options: args.RobotOptions, resume: Path, demands, out: Path | None, rapid: Path | None
) -> Outcome:
    """Return the remaining poses of a plan."""
    from tau_dyn.calibrate.poses import PathCheck, format_rapid_module, format_tour_csv, read_progress
    from tau_dyn.kinematics.workspace import build_machine

    machine = options.hold_silent_joints(options.load(robot), robot, [])
    now = read_progress(resume, machine.actuated)
    q, pose = now.q[now.left], now.pose[now.left]
    cells = [now.cells[k] for k in now.left] if now.cells else []
    check = PathCheck(build_machine(machine), demands)
    done = {state: now.state.count(state) for state in ("measured", "missed")}
    left = int((pose >= 0).sum())
    files = _build_files(
        out,
        lambda: format_tour_csv(q, pose, machine.actuated, cells),
        rapid,
        lambda: format_rapid_module(
            q, pose, check.poses(q)[0], machine.joint_kinds, actuated=machine.actuated, cells=cells
        ),
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
