"""What the optimiser moves: the actuated positions themselves, or one number that says how far along a path the robot is.

Both are `n` coordinates x over the normalised time, with x' and x'' by it; a motion of duration T has

    free:          q = x,     v = x'/T,        a = x''/T^2
    along a path:  q = q(s),  v = q_s s'/T,    a = (q_ss s'^2 + q_s s'')/T^2      (Bobrow, Dubowsky & Gibson 1985)

so that a path restricts a motion by nothing but another choice of coordinates (Dressler 2012, section 3.5).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from tau_dyn.control.motion.expressions import import_casadi
from tau_dyn.control.motion.path import JointPath


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
        """Take both ends, and where to start searching, from a path."""
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
        """Return them as they are."""
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
