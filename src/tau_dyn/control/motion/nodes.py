"""A motion at its nodes, all the unknowns of the program, and the motion between them.

Between N + 1 even nodes the acceleration is linear in time, so speeds and positions follow exactly (d = 1/N):

    x'_k+1 = x'_k + d/2 (x''_k + x''_k+1),   x_k+1 = x_k + d x'_k + d^2 (x''_k / 3 + x''_k+1 / 6)

The trapezoidal speed profile that a search starts from: a third each of constant acceleration, speed and deceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import Actuated, Coordinates
from tau_dyn.control.motion.expressions import ForceLaw
from tau_dyn.control.motion.limits import MotionLimits

_FLAT = 1e-3  # share of the largest inner unknown below which none is scaled


@dataclass(frozen=True, eq=False)
class Nodes:
    """A motion at the nodes.

    Attributes:
        x: Coordinates (N + 1, n).
        dx: Their derivative by the normalised time.
        ddx: And the second.
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
        coordinates: What moves.
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
    """Return forces and start with inner unknowns measured by their largest value at the start.

    They are speeds, accelerations and forces of the passive joints, some a thousand times larger than others; the solver treats a
    unit of each alike, and takes small steps where they differ (measured in docs/explanation/control.md).
    """
    size = np.abs(start.y).max(axis=0, initial=0.0)
    size = np.maximum(size, max(_FLAT * size.max(initial=0.0), 1e-6))
    return law.in_units(size), replace(start, y=start.y / size)


def build_node_motion(coordinates: Coordinates, nodes: Nodes, share: np.ndarray, T: float) -> Actuated:
    """Return the joints' motion (M, na) at shares (M,) of the duration, exactly as the nodes say, over a duration T [s]."""
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
_FALLBACK = 2.0  # [s] where weight alone is beyond a limit on the way
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
    """Return the speed (na,) within which friction changes its sign: what the profile gains in half an interval."""
    x, dx, ddx = coordinates.along(*profile)
    _, v, _ = coordinates.motion(x, dx, ddx, T)
    return np.maximum(np.abs(v).max(axis=0) / (2 * _THIRD * intervals), _MIN_SPEED)
