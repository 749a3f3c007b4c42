"""Where `accuracy` looks without being told: a section through home that the robot reaches, or its whole motion."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.section import UNLIMITED, Grid, Section, describe_unreached, lay_grid
from tau_dyn.mechanism import Poses, Rods, forward_kinematics, jacobian
from tau_dyn.robot import Robot

ENOUGH_POINTS = 10
"""Reached points of a default section; with fewer the other sections through home are tried."""
_NEARBY = 0.05  # [m or rad] from home, where directions of motion are looked for
_STILL = 1e-9  # share of the largest speed below which the tool does not move along an axis
_FLAT = 1e-9  # [m] extent of the tool's motion along an axis below which it stays in a plane


def choose_default_section(robot: Robot, tool: Poses, rods: Rods | None) -> Section:
    """Return the section through home across the guideways; where nothing slides, across z.

    Without rods it is the plane of the tool's motion where that is one orthogonal to an axis, else across y.
    """
    axis = 1 if rods is not None else _find_plane(robot)
    if rods is not None:
        sliding = [j for j, kind in enumerate(robot.joint_kinds) if kind == "prismatic"]
        travel = np.abs(rods.base_jacobian(robot.home[None])[0][:, :, sliding]).sum(axis=(0, 2))
        axis = int(np.argmax(travel)) if travel.any() else 2
    return _cut_at_home(axis, tool)


def lay_default_grid(robot: Robot, rods: Rods | None, tool: Poses, n: int, *, limits: bool = True) -> Grid:
    """Return a grid over the default section, or over another one through home where the robot reaches too little of that.

    Args:
        robot: The robot.
        rods: Its rods; None for another mechanism.
        tool: Pose of the tool at home (1 sample).
        n: Points along the longer side.
        limits: Whether actuators must stay within their limits.

    Raises:
        InputError: The robot reaches nothing of the three sections through home.
    """
    first = choose_default_section(robot, tool, rods)
    best: Grid | None = None
    for section in (first, *(_cut_at_home(axis, tool) for axis in range(3) if axis != first.axis)):
        try:
            grid = lay_grid(robot, rods, tool, section, n, limits=limits)
        except InputError:
            continue
        if best is None or grid.ok.sum() > best.ok.sum():
            best = grid
        if best.ok.sum() >= ENOUGH_POINTS:
            return best
    if best is None:
        raise InputError("invalid_value", describe_unreached(robot, first, tool))
    return best


def sample_default_motion(robot: Robot, n: int) -> tuple[np.ndarray, Poses] | None:
    """Return at least n positions (m, na) over the whole motion of one or two actuators, and the poses of those that close.

    A section crosses the tool's curve or curved surface in a few points only. None where a section suits: more actuators, or
    two that keep the tool in a plane orthogonal to an axis.
    """
    if robot.na > 2:
        return None
    q = sample_motion(robot, n)
    found = forward_kinematics(robot, q)
    places = found.poses.position[found.ok]
    if not len(places) or (robot.na == 2 and (np.ptp(places, axis=0) < _FLAT).any()):
        return None
    return q[found.ok], found.poses.take(found.ok)


def sample_motion(robot: Robot, n: int) -> np.ndarray:
    """Return at least n positions (m, na) [m or rad], evenly over all actuators' ranges.

    An actuator without limits goes a quarter turn or 0.5 m to each side of home.
    """
    reach = np.where(np.array(robot.joint_kinds) == "revolute", np.pi / 2, 0.5)
    low = np.where(np.abs(robot.lower) < UNLIMITED, robot.lower, robot.home - reach)
    high = np.where(np.abs(robot.upper) < UNLIMITED, robot.upper, robot.home + reach)
    each = int(np.ceil(n ** (1 / robot.na) - 1e-9))
    ranges = [np.linspace(a, b, max(2, each)) for a, b in zip(low, high, strict=True)]
    return np.stack([x.ravel() for x in np.meshgrid(*ranges, indexing="ij")], axis=1)


def _cut_at_home(axis: int, tool: Poses) -> Section:
    return Section(axis, round(float(tool.position[0, axis]), 9) + 0.0)


def _find_plane(robot: Robot) -> int:
    """Return the axis orthogonal to all velocities of the tool at home and near it; 1 where there is none."""
    near = robot.home + np.random.default_rng(0).uniform(-_NEARBY, _NEARBY, (4, robot.na))
    J = jacobian(robot, np.vstack([robot.home, near]))[:, :3]
    speeds = np.nan_to_num(np.abs(J)).max(axis=(0, 2))
    still = np.flatnonzero(speeds < _STILL * speeds.max())
    return int(still[0]) if len(still) == 1 else 1
