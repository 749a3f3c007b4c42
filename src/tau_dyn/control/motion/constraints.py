r"""What the program asks: limits, closed loops and costs at one place; how places and nodes hang together.

A fully actuated robot's forces follow from its motion (it is flat), so no differential equation of the dynamics is integrated:
`tau = f(q, v, a)` stands within its limits at every node and half-way between.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tau_dyn.control.motion.coordinates import Coordinates
from tau_dyn.control.motion.expressions import ForceLaw, import_casadi
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.pointwise import Pointwise

_SMALL = 1e-4
"""What full force of all drives costs of the duration. The shortest time leaves forces undetermined where one drive alone holds
the robot back; without any preference the solver wanders there. It cannot lengthen a motion by more than this share."""


def build_point_constraint(law: ForceLaw, coordinates: Coordinates, limits: MotionLimits, weight: float) -> Any:
    """Return the casadi function of one place `u = (x, x', x'', p, y, T)`: what is limited, residuals, cost by the time."""
    ca = import_casadi()
    n, n_p, n_y = coordinates.n, law.n_passive, law.n_inner
    u = ca.MX.sym("u", 3 * n + n_p + n_y + 1)
    edges = np.cumsum([0, n, n, n, n_p, n_y, 1])
    x, dx, ddx, p, y, T = (u[int(i) : int(j)] for i, j in zip(edges[:-1], edges[1:], strict=True))
    _, v, a = at = coordinates.symbols(x, dx, ddx, T)
    tau = law.forces(*at, p, y)
    values = {"force": tau, "speed": v, "acceleration": a}
    scaled = ca.vertcat(*(values[name][k] / getattr(limits, name)[k] for name, k in list_limited_quantities(limits)))
    point = ca.Function("point", [u], [scaled, law.residual(*at, p, y), T * _squares(tau, limits.force, weight)])
    return point if coordinates.forward else point.expand()  # splines cannot be expanded


def _squares(tau: Any, limit: np.ndarray, weight: float) -> Any:
    """Return the weighted squares of forces, and of their share of the limits by so little that no time is lost."""
    small = _SMALL / len(limit) / limit**2  # zero for a joint without a limit
    return import_casadi().dot(import_casadi().DM(weight + small), tau**2)


def build_jerk_constraints(coordinates: Coordinates, limits: MotionLimits, pointwise: Pointwise, W: Any, N: int) -> Any:
    """Return the jerks between nodes and middles as shares of their limits; no rows where there are none."""
    ca, n = import_casadi(), coordinates.n
    kept = np.flatnonzero(np.isfinite(limits.jerk)).tolist()
    if not kept:
        return ca.MX(0, 1)
    u = ca.MX.sym("u", pointwise.width)
    acceleration = coordinates.symbols(u[:n], u[n : 2 * n], u[2 * n : 3 * n], u[-1]).a
    a = ca.Function("a", [u], [acceleration]).map(2 * N + 1)(pointwise.points(W))
    change = (a[kept, 1:] - a[kept, :-1]) * (2 * N / W[-1])
    return ca.vec(ca.mtimes(ca.diag(ca.DM(1 / limits.jerk[kept])), change))


def build_integration_constraints(x: Any, dx: Any, ddx: Any, N: int) -> Any:
    """Return what is zero where positions and speeds follow from the accelerations."""
    ca, d = import_casadi(), 1 / N
    speeds = dx[:, 1:] - dx[:, :-1] - d / 2 * (ddx[:, 1:] + ddx[:, :-1])
    places = x[:, 1:] - x[:, :-1] - d * dx[:, :-1] - d * d * (ddx[:, :-1] / 3 + ddx[:, 1:] / 6)
    return ca.vertcat(ca.vec(speeds), ca.vec(places))


def compute_slope(linear: Any, w: Any) -> Any:
    """Return the constant matrix of an expression that is linear in w."""
    return import_casadi().evalf(import_casadi().jacobian(import_casadi().vec(linear), w))


def compute_simpson_weights(N: int) -> np.ndarray:
    """Return weights (2 N + 1,) of Simpson's rule over nodes and middles."""
    return np.array([1.0, *[4.0, 2.0] * (N - 1), 4.0, 1.0]) / (6 * N)


def insert_middles(x: Any, dx: Any, ddx: Any, N: int) -> list[Any]:
    """Return coordinates and derivatives (n, 2 N + 1) at the nodes and half-way between them, by `build_node_motion`'s cubic."""
    ca, h = import_casadi(), 0.5 / N
    left, right = ddx[:, :-1], ddx[:, 1:]
    middles = (
        x[:, :-1] + h * dx[:, :-1] + h**2 * (5 * left + right) / 12,
        dx[:, :-1] + h * (3 * left + right) / 4,
        (left + right) / 2,
    )
    order = np.argsort(np.concatenate([np.arange(N + 1), np.arange(N) + 0.5]), kind="stable").tolist()
    return [ca.horzcat(z, middle)[:, order] for z, middle in zip((x, dx, ddx), middles, strict=True)]


def list_limited_quantities(limits: MotionLimits) -> list[tuple[str, int]]:
    """Return what has a limit: pairs of quantity ('force', 'speed', 'acceleration') and joint index."""
    quantities = ("force", "speed", "acceleration")
    return [(name, int(k)) for name in quantities for k in np.flatnonzero(np.isfinite(getattr(limits, name)))]
