"""`tau-dyn plan-motion`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_COLUMNS = ("x_tool", "y_tool", "z_tool")
_ENDS = Group("Where")
_LIMITS = Group("Limits, one or one a joint")


@Parameter(name="*", group=_ENDS)
@dataclass(frozen=True, kw_only=True)
class Ends:
    """Where a motion starts and ends, and along which path.

    Attributes:
        start: Tool position at the start [m]
        end: Tool position at the end [m]
        start_joints: Actuated positions instead of --from [m or rad]
        end_joints: Actuated positions instead of --to [m or rad]
        path: line: the tool goes straight; a table with x_tool, y_tool, z_tool: a spline through these points (default:
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
            InputError: They are given twice, or not at all.
        """
        if self.start and self.end and not (self.start_joints or self.end_joints):
            return np.array(self.start), np.array(self.end), False
        if self.start_joints and self.end_joints and not (self.start or self.end):
            return np.array(self.start_joints), np.array(self.end_joints), True
        raise InputError(
            "bad_option",
            "say where the motion starts and ends: --from X Y Z --to X Y Z, or --from-joints and --to-joints",
        )

    def read_path(self):
        """Return None, 'line', or the points of a table (n, 3) [m].

        Raises:
            InputError: The table is missing, or a column of it.
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
    """What a motion may not exceed.

    Attributes:
        force_limit: Largest force [N or N m] (default the robot file's)
        speed_limit: Largest speed [m/s or rad/s] (default the robot file's)
        acceleration_limit: Largest acceleration [m/s^2 or rad/s^2] (default none)
        jerk_limit: Largest jerk [m/s^3 or rad/s^3] (default none)
        margin: Share of the forces that is kept for the feedback
        condition: Largest conditioning of the loops
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
    """The fastest motion between two places that the drives can follow, or one with less effort; free or along a path.

    Args:
        energy_weight: Minimise T + W times the integral of squared forces [s per N^2 s] (0: the shortest time)
        rate: Of the motion
        nodes: Intervals of linear acceleration
        period: Of the controller; no interval is shorter
    """
    start, end, joints = ends.choose()
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.motion import MotionLimits, plan_motion as plan

        model = _load_model(robot, robot_options)
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


def _load_model(robot: str, options: args.RobotOptions):
    """Return the model that ROBOT names: a file of ours with its effects, or a rigid robot."""
    from tau_dyn.model import Model

    if not args.is_saved_model(robot):
        return Model.of(options.load(robot))
    if options.set or options.actuated:
        raise InputError(
            "bad_option", f"{robot} is a model file, which carries its own robot; leave --set and --actuated out"
        )
    return Model.load(robot)
