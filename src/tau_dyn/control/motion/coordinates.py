"""Coordinates of the optimisation: the actuated positions themselves, or the path parameter of the robot.

Both are `n` coordinates x over the normalised time, with derivatives x' and x''. A motion of duration T has

    free:          q = x,     v = x'/T,        a = x''/T^2
    along a path:  q = q(s),  v = q_s s'/T,    a = (q_ss s'^2 + q_s s'')/T^2      (Bobrow, Dubowsky & Gibson 1985)

so that a path restricts a motion only by another choice of coordinates (Dressler 2012, section 3.5).

`JointPath` is a tool path as actuated positions `q(s)`, s from 0 to 1, in proportion to the distance of the tool along the path.
The path is a straight line or a cubic spline through points; its orientation turns evenly from start to end. Poses along it are
solved in one branch (`kinematics.follow_path`) and joined by a quintic spline, which has two continuous derivatives and two more
for the derivatives of the program.

`Nodes` holds all unknowns of the program: the motion at its nodes. Between N + 1 even nodes the acceleration is linear in time,
so speeds and positions follow exactly (d = 1/N):

    x'_k+1 = x'_k + d/2 (x''_k + x''_k+1),   x_k+1 = x_k + d x'_k + d^2 (x''_k / 3 + x''_k+1 / 6)

A search starts from a trapezoidal speed profile: one third each of constant acceleration, speed and deceleration.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.expressions import ForceLaw, import_casadi
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import follow_path
from tau_dyn.mechanism import Poses, forward_kinematics
from tau_dyn.model import Model

PathShape = Literal["line"] | np.ndarray
"""'line', or tool positions (n, 3) [m] that the path goes through."""

SAMPLES = 241  # points on a path, an odd number so that one is its middle
_FINE = 20  # samples of a spline between two points, to measure its way
_OFF = 1e-6  # [m or rad] error of the spline between samples beyond which it is not the path
_MAX_COORDINATE_M = 1e6  # [m] beyond the reach of any robot


@dataclass(frozen=True, eq=False)
class JointPath:
    """Actuated positions along a path.

    Attributes:
        q: Spline of degree 5 over s in [0, 1], values (na,) [m or rad].
        length: Length of the tool's path [m]; for a path in joint space, the distance in joint space.
    """

    q: BSpline
    length: float


def build_joint_line(start: np.ndarray, end: np.ndarray) -> JointPath:
    """Return the straight path between actuated positions (na,)."""
    s = np.linspace(0, 1, 7)[:, None]
    spline = make_interp_spline(s[:, 0], start + s * (end - start), k=5)
    return JointPath(spline, float(np.linalg.norm(end - start)))


def build_tool_path(
    model: Model, start: np.ndarray, end: np.ndarray, shape: PathShape, limits: MotionLimits
) -> JointPath:
    """Return a path of the tool between actuated positions (na,).

    Args:
        model: The robot.
        start: Actuated positions at its start (na,).
        end: Actuated positions at its end (na,).
        shape: 'line', or points (n, 3) [m] between or including both ends.
        limits: The joints' ranges and the conditioning are checked along it.

    Raises:
        InputError: The path leaves the workspace, a joint's range, or the branch, or comes near a singularity.
    """
    poses, length = _poses(model, start, end, shape)
    s = np.linspace(0, 1, len(poses.position))
    found = follow_path(model.robot, poses, start=start)
    if found.until < len(s):
        at = _at(poses.position[found.until])
        raise InputError(
            "unreachable", f"the path cannot be followed beyond {100 * s[found.until]:.0f} % at {at}: {found.reason}"
        )
    _check_range(model, found.q, poses, limits)
    spline = make_interp_spline(s, found.q, k=5)
    if np.abs(found.q[-1] - end).max() > 1e-6:
        raise InputError("unreachable", "the path ends in another configuration of the robot than the end asks for")
    _check_spline(model, spline, poses, start)
    return JointPath(spline, length)


def _poses(model: Model, start: np.ndarray, end: np.ndarray, shape: PathShape) -> tuple[Poses, float]:
    """Return evenly spaced poses along the path and its length [m]."""
    ends = forward_kinematics(model.robot, np.stack([start, end])).poses
    points = _points(shape, ends.position)
    place, length = _evenly(points)
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(ends.rotation))
    return Poses(place, turn(np.linspace(0, 1, SAMPLES)).as_matrix()), length


def _points(shape: PathShape, ends: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) of a path, both ends included, without repetition."""
    if isinstance(shape, str):
        if shape != "line":
            raise InputError("invalid_value", f"the path is 'line' or points (n, 3) [m], not '{shape}'")
        points = ends
    else:
        between = np.asarray(shape, float)
        if between.ndim != 2 or between.shape[1] != 3:
            raise InputError(
                "wrong_shape", f"the points of a path are numbers (n, 3) [m], not an array of {between.shape}"
            )
        if not (np.abs(between) < _MAX_COORDINATE_M).all():
            raise InputError(
                "invalid_value", f"the points of a path are finite numbers of less than {_MAX_COORDINATE_M:g} m"
            )
        points = np.concatenate([ends[:1], between, ends[1:]])
    new = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
    points = points[np.concatenate([[True], new])]
    if len(points) < 2:
        raise InputError("invalid_value", "the path has no length: start and end are one place")
    return points


def _evenly(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return SAMPLES points evenly spaced on the line, or on the spline through the points, and its length [m]."""
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if len(points) == 2:
        return points[0] + np.linspace(0, 1, SAMPLES)[:, None] * (points[1] - points[0]), float(chord[-1])
    curve = CubicSpline(chord, points)
    fine = np.interp(np.linspace(0, 1, _FINE * SAMPLES), chord / chord[-1], chord)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    place = PchipInterpolator(way, fine)(np.linspace(0, way[-1], SAMPLES))
    return curve(place), float(way[-1])


def _check_range(model: Model, q: np.ndarray, poses: Poses, limits: MotionLimits) -> None:
    robot = model.robot
    outside = np.maximum(limits.lower - q, q - limits.upper)
    k, j = np.unravel_index(int(np.argmax(outside)), outside.shape)
    if outside[k, j] > 1e-9:
        allowed = f"{limits.lower[j]:g} to {limits.upper[j]:g} {robot.position_units[j]}"
        raise InputError(
            "unreachable",
            f"at {_at(poses.position[k])} the path asks {q[k, j]:.4g} of joint {robot.actuated[j]}, whose range is {allowed}",
        )
    condition = model.mechanism.condition(q)
    worst = int(np.argmax(condition))
    if condition[worst] > limits.condition:
        raise InputError(
            "unreachable",
            f"at {_at(poses.position[worst])} the path comes near a singularity of the loops: "
            f"conditioning {condition[worst]:.3g}, the limit is {limits.condition:.3g}",
        )


def _check_spline(model: Model, spline: BSpline, poses: Poses, start: np.ndarray) -> None:
    """Refuse a path whose positions change too sharply for the spline, as near a singularity of an arm."""
    s = np.linspace(0, 1, len(poses.position))
    middle = (s[1:] + s[:-1]) / 2
    place = forward_kinematics(model.robot, spline(middle)).poses.position
    straight = CubicSpline(s, poses.position)(middle)
    off = np.linalg.norm(place - straight, axis=1)
    worst = int(np.argmax(off))
    if not off[worst] < _OFF:
        where = _at(straight[worst])
        raise InputError(
            "unreachable", f"at {where} the path asks joints to turn at once, as near a singularity or at a corner"
        )


def _at(place: np.ndarray) -> str:
    """Return a place (3,) [m] in words."""
    return f"({', '.join(f'{x:.4g}' for x in place)}) m"


class Actuated(NamedTuple):
    """Positions, speeds and accelerations of the actuated joints (N, na), or casadi columns (na,)."""

    q: Any
    v: Any
    a: Any


class Coordinates(ABC):
    """A choice of coordinates between two states of rest.

    Attributes:
        start: At the beginning (n,).
        end: At the end (n,).
        lower: Smallest values (n,).
        upper: Largest values (n,).
        forward: Whether they may only grow.
    """

    start: np.ndarray
    end: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    forward = False

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.start)

    @abstractmethod
    def symbols(self, x: Any, dx: Any, ddx: Any, T: Any) -> Actuated:
        """Return the joints' motion as casadi expressions of the coordinates (n,) and their derivatives."""

    @abstractmethod
    def motion(self, x: np.ndarray, dx: np.ndarray, ddx: np.ndarray, T: float) -> Actuated:
        """Return the joints' motion (N, na) at coordinates and derivatives (N, n)."""

    @abstractmethod
    def along(self, s: np.ndarray, ds: np.ndarray, dds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return coordinates and derivatives (N, n) of a motion along the starting path, by its share s (N,)."""


class Free(Coordinates):
    """The actuated positions."""

    def __init__(self, path: JointPath, lower: np.ndarray, upper: np.ndarray) -> None:
        """Take both ends, and the start of the search, from a path."""
        self.path, self.lower, self.upper = path, lower, upper
        self.start, self.end = path.q(0.0), path.q(1.0)

    def symbols(self, x: Any, dx: Any, ddx: Any, T: Any) -> Actuated:
        """Return `x, x'/T, x''/T^2`."""
        return Actuated(x, dx / T, ddx / T**2)

    def motion(self, x: np.ndarray, dx: np.ndarray, ddx: np.ndarray, T: float) -> Actuated:
        """Return `x, x'/T, x''/T^2`."""
        return Actuated(x, dx / T, ddx / T**2)

    def along(self, s: np.ndarray, ds: np.ndarray, dds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the path's positions and their derivatives by the normalised time."""
        return tuple(_chained(self.path.q, s[:, None], ds[:, None], dds[:, None], 1.0))  # type: ignore[return-value]


class Along(Coordinates):
    """The share of a path."""

    forward = True

    def __init__(self, path: JointPath) -> None:
        """Prepare for a path."""
        self.path = path
        self.start, self.end = np.zeros(1), np.ones(1)
        self.lower, self.upper = self.start, self.end

    def symbols(self, x: Any, dx: Any, ddx: Any, T: Any) -> Actuated:
        """Return the chain rule on splines."""
        q, first, second = (_spline(self.path.q.derivative(k), x) for k in range(3))
        return Actuated(q, first * (dx / T), (second * dx**2 + first * ddx) / T**2)

    def motion(self, x: np.ndarray, dx: np.ndarray, ddx: np.ndarray, T: float) -> Actuated:
        """Return the chain rule on splines."""
        return _chained(self.path.q, x, dx, ddx, T)

    def along(self, s: np.ndarray, ds: np.ndarray, dds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return them unchanged."""
        return s[:, None], ds[:, None], dds[:, None]


def _chained(q: BSpline, x: np.ndarray, dx: np.ndarray, ddx: np.ndarray, T: float) -> Actuated:
    s = np.clip(x[:, 0], 0.0, 1.0)
    first, second = q.derivative(1)(s), q.derivative(2)(s)
    return Actuated(q(s), first * dx / T, (second * dx**2 + first * ddx) / T**2)


def _spline(spline: BSpline, x: Any) -> Any:
    """Return a spline of SciPy's as a casadi expression (na,) of one number."""
    n = len(spline.t) - spline.k - 1  # SciPy keeps zeros behind a derivative's coefficients
    coefficients = np.ascontiguousarray(spline.c[:n]).ravel().tolist()
    return import_casadi().bspline(x, coefficients, [spline.t.tolist()], [int(spline.k)], spline.c.shape[1])


_FLAT = 1e-3  # share of the largest inner unknown: least scale of all of them


@dataclass(frozen=True, eq=False)
class Nodes:
    """A motion at the nodes.

    Attributes:
        x: Coordinates (N + 1, n).
        dx: Their derivative by the normalised time.
        ddx: Their second derivative.
        p: Passive joints at nodes and middles (2 N + 1, n_p).
        y: Solutions of the inner systems there (2 N + 1, n_y), in the law's units.
        T: Duration [s].
    """

    x: np.ndarray
    dx: np.ndarray
    ddx: np.ndarray
    p: np.ndarray
    y: np.ndarray
    T: float

    def flat(self) -> np.ndarray:
        """Return all unknowns in the program's order."""
        return np.concatenate([*(z.ravel() for z in (self.x, self.dx, self.ddx, self.p, self.y)), [self.T]])

    def like(self, flat: np.ndarray) -> Nodes:
        """Return nodes of the same shapes from all unknowns."""
        parts, at = [], 0
        for z in (self.x, self.dx, self.ddx, self.p, self.y):
            parts.append(flat[at : at + z.size].reshape(z.shape))
            at += z.size
        return Nodes(*parts, T=float(flat[at]))


def start_nodes(law: ForceLaw, coordinates: Coordinates, profile: tuple[np.ndarray, ...], T: float) -> Nodes:
    """Return the nodes of a motion along the starting path.

    Args:
        law: The forces.
        coordinates: Coordinates of the motion.
        profile: Share of the way, speed and acceleration by the normalised time, at nodes and middles (2 N + 1,).
        T: Duration [s].
    """
    x, dx, ddx = (z[::2] for z in coordinates.along(*profile))
    ddx[[0, -1]] = 0.0
    rough = Nodes(x, dx, ddx, np.zeros((len(profile[0]), 0)), np.zeros((len(profile[0]), 0)), T)
    q, v, a = build_node_motion(coordinates, rough, np.linspace(0, 1, len(profile[0])), T)
    p = law.passive(q)
    return replace(rough, p=p, y=law.inner(q, v, a, p))


def scale_unknowns(law: ForceLaw, start: Nodes) -> tuple[ForceLaw, Nodes]:
    """Return the force law and the start with inner unknowns scaled by their largest value at the start.

    Inner unknowns are speeds, accelerations and forces of the passive joints, some a thousand times larger than others. The
    solver treats one unit of each equally, and takes small steps if they differ (measured in docs/explanation/control.md).
    """
    size = np.abs(start.y).max(axis=0, initial=0.0)
    size = np.maximum(size, max(_FLAT * size.max(initial=0.0), 1e-6))
    return law.in_units(size), replace(start, y=start.y / size)


def build_node_motion(coordinates: Coordinates, nodes: Nodes, share: np.ndarray, T: float) -> Actuated:
    """Return the joints' motion (M, na) at shares (M,) of the duration T [s], exactly as defined by the nodes."""
    N = len(nodes.x) - 1
    k = np.minimum((share * N).astype(int), N - 1)
    h = (share - k / N)[:, None]
    jerk = (nodes.ddx[k + 1] - nodes.ddx[k]) * N
    x = nodes.x[k] + h * (nodes.dx[k] + h * (nodes.ddx[k] / 2 + h * jerk / 6))
    dx = nodes.dx[k] + h * (nodes.ddx[k] + h * jerk / 2)
    return coordinates.motion(x, dx, nodes.ddx[k] + h * jerk, T)


_THIRD = 1 / 3  # of the time each for speeding up, cruising and slowing down: least peak power
_FIRST, _LAST = 0.02, 300.0  # [s] shortest and longest duration that is tried
_GROWTH = 1.15  # factor on the duration of a first guess until limits hold
_FALLBACK = 2.0  # [s] if weight alone exceeds a limit on the way
_MIN_SPEED = 1e-3  # [m/s or rad/s]


def compute_trapezoid(intervals: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return share of the way, speed and acceleration (2 intervals + 1,) by the normalised time, at nodes and middles.

    The acceleration is linear between the nodes and zero at both ends, as the program's is.
    """
    nodes, h = np.linspace(0, 1, intervals + 1), 1 / (2 * intervals)
    rate = np.where(nodes < _THIRD - 1e-9, 1.0, np.where(nodes > 1 - _THIRD + 1e-9, -1.0, 0.0))
    rate[[0, -1]] = 0.0
    a = np.interp(np.linspace(0, 1, 2 * intervals + 1), nodes, rate)
    v = np.concatenate([[0], np.cumsum(h / 2 * (a[1:] + a[:-1]))])
    s = np.concatenate([[0], np.cumsum(h * v[:-1] + h**2 * (a[:-1] / 3 + a[1:] / 6))])
    return s / s[-1], v / s[-1], a / s[-1]


def compute_min_duration(
    coordinates: Coordinates, feedforward: Feedforward, limits: MotionLimits, profile: tuple[np.ndarray, ...]
) -> float:
    """Return nearly the shortest duration [s] at which a profile along the starting path keeps all limits."""
    x, dx, ddx = coordinates.along(*profile)
    T = _FIRST
    while T < _LAST:
        q, v, a = coordinates.motion(x, dx, ddx, T)
        used = [np.abs(feedforward(q, v, a)) / limits.force, np.abs(v) / limits.speed, np.abs(a) / limits.acceleration]
        if max(float(np.max(x)) for x in used) <= 1:
            return T
        T *= _GROWTH
    return _FALLBACK


def compute_smoothing_width(
    coordinates: Coordinates, profile: tuple[np.ndarray, ...], T: float, intervals: int
) -> np.ndarray:
    """Return the speed (na,) within which friction changes its sign: the gain of the profile in half an interval."""
    x, dx, ddx = coordinates.along(*profile)
    _, v, _ = coordinates.motion(x, dx, ddx, T)
    return np.maximum(np.abs(v).max(axis=0) / (2 * _THIRD * intervals), _MIN_SPEED)
