"""A flat section through the workspace, a grid over its reachable part, and the default section of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.workspace import commands_positions
from tau_dyn.mechanism import Kinematics, Poses, build_kinematics
from tau_dyn.robot import Robot

AXES = "xyz"
_REACHED = 1e-8
"""[m] Largest distance from the requested position that counts as reached."""
COARSE = 25
"""Points to a side of the first, coarse look for the workspace."""
UNLIMITED = 1e5
"""[m or rad] A joint limit beyond this counts as unlimited."""


@dataclass(frozen=True)
class Section:
    """A plane orthogonal to an axis of the base, and the range within it.

    Attributes:
        axis: 0, 1, 2 for x, y, z.
        value: Coordinate at which it cuts that axis [m].
        across: Range of each of the other two axes [m]; None for the range that the robot reaches.
    """

    axis: int
    value: float
    across: tuple[tuple[float, float], tuple[float, float]] | None = None

    @property
    def others(self) -> tuple[int, int]:
        """The two axes within the section, the horizontal one of a drawing first."""
        return ((1, 2), (0, 2), (0, 1))[self.axis]

    def within(self, ranges: Sequence[str]) -> Section:
        """Return the section limited by words such as `y=-1:0.5`, one per axis of the section; without words unlimited.

        Raises:
            InputError: A word has another form, or only one axis has a range.
        """
        if not ranges:
            return self
        found = dict(_range(text) for text in ranges)
        wanted = [AXES[k] for k in self.others]
        if sorted(found) != wanted:
            raise InputError(
                "bad_option", f"--range: a section {self.words} needs a range of {wanted[0]} and one of {wanted[1]}"
            )
        return replace(self, across=(found[wanted[0]], found[wanted[1]]))

    @property
    def words(self) -> str:
        """Text such as `x = 1.75 m`."""
        return f"{AXES[self.axis]} = {self.value:.4g} m"


@dataclass(frozen=True, eq=False)
class Grid:
    """A section's points, and the robot's positions there.

    Attributes:
        section: The section with its range.
        u: Horizontal coordinates (nu,) [m].
        v: Vertical coordinates (nv,) [m].
        poses: Tool poses (nv * nu), v the slower.
        q: Actuated positions (nv * nu, na), nan for points that are not reached.
        ok: Whether the robot reaches the point (nv * nu,).
    """

    section: Section
    u: np.ndarray
    v: np.ndarray
    poses: Poses
    q: np.ndarray
    ok: np.ndarray

    def on_grid(self, values: np.ndarray) -> np.ndarray:
        """Return values of the reached points (n_ok,) as a picture (nv, nu), nan elsewhere."""
        picture = np.full(len(self.ok), np.nan)
        picture[self.ok] = values
        return picture.reshape(len(self.v), len(self.u))


def read_section(text: str) -> Section:
    """Read `x=1.75`.

    Raises:
        InputError: The text is not of this kind.
    """
    name, equals, number = (part.strip() for part in text.partition("="))
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if not equals or name not in AXES or len(name) != 1 or not abs(value) < 1e6:
        raise InputError("bad_option", f"--section {text}: write an axis and where to cut it, such as x=1.75")
    return Section(AXES.index(name), value)


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, equals, ends = (part.strip() for part in text.partition("="))
    low, colon, high = ends.partition(":")
    try:
        low_high = float(low), float(high)
    except ValueError:
        low_high = np.nan, np.nan
    if not equals or not colon or not -1e6 < low_high[0] < low_high[1] < 1e6:
        raise InputError("bad_option", f"--range {text}: write an axis, its low and its high end, such as y=-1:0.5")
    return name, low_high


def lay_grid(
    robot: Robot | Kinematics, section: Section, n: int, *, limits: bool = True, reach: float | None = None
) -> Grid:
    """Return a grid over the part of a section that the robot reaches, with the home's orientation.

    Args:
        robot: The robot, or its kinematics.
        section: The section.
        n: Points along the longer side.
        limits: Whether actuators must stay within their limits.
        reach: Search radius around home [m]; None for a value from the mechanism's size.

    Raises:
        InputError: The robot does not reach the section.
    """
    kinematics, range_ = build_kinematics(robot), section.across
    tool = kinematics.commanded.home
    if range_ is None:
        far = _size(kinematics, tool) if reach is None else reach
        home = tool.position[0, list(section.others)]
        u, v = (np.linspace(h - far, h + far, COARSE) for h in home)
        coarse = _filled(kinematics, tool, section, u, v, limits)
        range_ = _around(coarse, kinematics)
    (u0, u1), (v0, v1) = range_
    step = max(u1 - u0, v1 - v0) / max(n - 1, 1)
    u, v = (np.linspace(a, b, max(2, round((b - a) / step) + 1)) for a, b in ((u0, u1), (v0, v1)))
    grid = _filled(kinematics, tool, Section(section.axis, section.value, range_), u, v, limits)
    if not grid.ok.any():
        raise InputError("invalid_value", _describe_unreached(kinematics, section, tool))
    return grid


def _filled(kinematics: Kinematics, tool: Poses, section: Section, u: np.ndarray, v: np.ndarray, limits: bool) -> Grid:
    """Solve a grid, outwards from the point nearest home; all points at once if that point is not reached."""
    a, b = section.others
    position = np.empty((len(v), len(u), 3))
    position[..., section.axis] = section.value
    position[..., a], position[..., b] = u[None, :], v[:, None]
    position = position.reshape(-1, 3)
    rotation = np.broadcast_to(tool.rotation, (len(position), 3, 3)).copy()
    grid = Grid(
        section,
        u,
        v,
        Poses(position, rotation),
        np.full((len(position), kinematics.robot.na), np.nan),
        np.zeros(len(position), bool),
    )
    shape, tried = (len(v), len(u)), np.zeros((len(v), len(u)), bool)
    front = np.zeros(shape, bool)
    front.flat[int(np.argmin(np.linalg.norm(position - tool.position[0], axis=1)))] = True
    while front.any():
        _solve(kinematics, grid, np.flatnonzero(front), limits)
        tried |= front
        front = binary_dilation(grid.ok.reshape(shape), np.ones((3, 3))) & ~tried if grid.ok.any() else ~tried
    return grid


def _solve(kinematics: Kinematics, grid: Grid, index: np.ndarray, limits: bool) -> None:
    """Fill in the grid's points at an index: positions, and the orientation that the robot reaches there."""
    asked = grid.poses.take(index)
    found = kinematics.inverse(asked, limits=limits)
    there = np.flatnonzero(found.ok)
    q, asked = found.q[there], asked.take(there)
    really = kinematics.forward(q, start=asked)
    near = really.ok & (np.linalg.norm(really.poses.position - asked.position, axis=1) < _REACHED)
    near[near] = _is_on_home_side(kinematics, q[near], really.poses.take(near))
    at = index[there[near]]
    grid.ok[at], grid.q[at], grid.poses.rotation[at] = True, q[near], really.poses.rotation[near]


def _is_on_home_side(kinematics: Kinematics, q: np.ndarray, poses: Poses) -> np.ndarray:
    """Return which poses are on home's side of the parallel singularities, so that they are reached without crossing one."""
    home = kinematics.closure_by_pose(kinematics.robot.home[None], kinematics.commanded.home)
    return np.sign(np.linalg.det(kinematics.closure_by_pose(q, poses))) == np.sign(np.linalg.det(home))


def _around(coarse: Grid, kinematics: Kinematics) -> tuple[tuple[float, float], tuple[float, float]]:
    picture = coarse.ok.reshape(len(coarse.v), len(coarse.u))
    if not picture.any():
        raise InputError("invalid_value", _describe_unreached(kinematics, coarse.section, None))
    ends = []
    for x, axis in ((coarse.u, 0), (coarse.v, 1)):
        inside, step = np.flatnonzero(picture.any(axis=axis)), x[1] - x[0]
        ends.append((float(x[inside[0]] - step), float(x[inside[-1]] + step)))
    return ends[0], ends[1]


def _describe_unreached(kinematics: Kinematics, section: Section, tool: Poses | None) -> str:
    """Return the sentence about a section that the robot does not reach."""
    axis = AXES[section.axis]
    home = "" if tool is None else f"; at home the tool is at {axis}={tool.position[0, section.axis]:.4g}"
    return (
        f"{kinematics.robot.source} reaches no point of the section {section.words}{home}; "
        "cut where it goes (without limits: --no-limits), or list --poses"
    )


def _size(kinematics: Kinematics, tool: Poses) -> float:
    """Return a distance from home that the tool does not exceed [m]."""
    robot, legs = kinematics.robot, kinematics.legs
    if legs is not None:
        A, L = legs.base_points(robot.home[None])[0], legs.leg_lengths(robot.home[None])[0]
        return float(np.max(np.linalg.norm(A - tool.position[0], axis=1) + L))
    lengths = [float(np.linalg.norm(p.translation)) for p in robot.model.jointPlacements]
    travel = (robot.upper - robot.lower)[np.array(robot.joint_kinds) == "prismatic"]
    return sum(lengths) + float(travel[travel < UNLIMITED].sum() + np.linalg.norm(tool.position[0]) * 0.1) + 0.1


ENOUGH_POINTS = 10
"""Reached points of a default section; with fewer the other sections through home are tried."""
_NEARBY = 0.05  # [m or rad] from home, within which directions of motion are determined
_STILL = 1e-9  # share of the largest speed below which the tool does not move along an axis
_FLAT = 1e-9  # [m] extent of the tool's motion along an axis below which it stays in a plane


def choose_default_section(robot: Robot | Kinematics) -> Section:
    """Return the section through home across the guideways; across z if no actuator slides.

    Without legs it is the plane of the tool's motion if that plane is orthogonal to an axis, else across y.
    """
    kinematics = build_kinematics(robot)
    owner, legs = kinematics.robot, kinematics.legs
    if legs is None:
        return _cut_at_home(kinematics, _find_plane(kinematics))
    sliding = [j for j, kind in enumerate(owner.joint_kinds) if kind == "prismatic"]
    travel = np.abs(legs.base_jacobian(owner.home[None])[0][:, :, sliding]).sum(axis=(0, 2))
    return _cut_at_home(kinematics, int(np.argmax(travel)) if travel.any() else 2)


def lay_default_grid(robot: Robot | Kinematics, n: int, *, limits: bool = True) -> Grid:
    """Return a grid over the default section, or over another one through home if the robot reaches too little of it.

    Args:
        robot: The robot, or its kinematics.
        n: Points along the longer side.
        limits: Whether actuators must stay within their limits.

    Raises:
        InputError: The robot does not reach any of the three sections through home.
    """
    kinematics = build_kinematics(robot)
    first = choose_default_section(kinematics)
    best: Grid | None = None
    for section in (first, *(_cut_at_home(kinematics, axis) for axis in range(3) if axis != first.axis)):
        try:
            grid = lay_grid(kinematics, section, n, limits=limits)
        except InputError:
            continue
        if best is None or grid.ok.sum() > best.ok.sum():
            best = grid
        if best.ok.sum() >= ENOUGH_POINTS:
            return best
    if best is None:
        raise InputError("invalid_value", _describe_unreached(kinematics, first, kinematics.commanded.home))
    return best


def sample_default_motion(robot: Robot, n: int) -> tuple[np.ndarray, Poses] | None:
    """Return at least n positions (m, na) over a robot's whole motion, and the poses of those that close.

    A section crosses the curve or curved surface of one or two actuators in a few points only, and is not defined for a tool
    whose position is not commanded (a 3-PRS). The result is None if a section is suitable: for other robots with more
    actuators, or with two that keep the tool in a plane orthogonal to an axis.
    """
    kinematics = build_kinematics(robot)
    if robot.na > 2 and commands_positions(kinematics):
        return None
    q = sample_motion(robot, n)
    found = kinematics.forward(q)
    places = found.poses.position[found.ok]
    if not len(places) or (robot.na == 2 and (np.ptp(places, axis=0) < _FLAT).any()):
        return None
    return q[found.ok], found.poses.take(found.ok)


def sample_motion(robot: Robot, n: int) -> np.ndarray:
    """Return at least n positions (m, na) [m or rad], evenly over all actuators' ranges.

    An actuator without limits moves by a quarter turn or 0.5 m to each side of home.
    """
    reach = np.where(np.array(robot.joint_kinds) == "revolute", np.pi / 2, 0.5)
    low = np.where(np.abs(robot.lower) < UNLIMITED, robot.lower, robot.home - reach)
    high = np.where(np.abs(robot.upper) < UNLIMITED, robot.upper, robot.home + reach)
    each = int(np.ceil(n ** (1 / robot.na) - 1e-9))
    ranges = [np.linspace(a, b, max(2, each)) for a, b in zip(low, high, strict=True)]
    return np.stack([x.ravel() for x in np.meshgrid(*ranges, indexing="ij")], axis=1)


def _cut_at_home(kinematics: Kinematics, axis: int) -> Section:
    return Section(axis, round(float(kinematics.commanded.home.position[0, axis]), 9) + 0.0)


def _find_plane(kinematics: Kinematics) -> int:
    """Return the axis orthogonal to all velocities of the tool at home and near it; 1 if no axis is."""
    robot = kinematics.robot
    near = robot.home + np.random.default_rng(0).uniform(-_NEARBY, _NEARBY, (4, robot.na))
    J = kinematics.jacobian(np.vstack([robot.home, near]))[:, :3]
    speeds = np.nan_to_num(np.abs(J)).max(axis=(0, 2))
    still = np.flatnonzero(speeds < _STILL * speeds.max())
    return int(still[0]) if len(still) == 1 else 1
