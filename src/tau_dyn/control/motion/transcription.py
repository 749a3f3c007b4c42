r"""The motion as a nonlinear program: direct collocation of coordinates over the normalised time, forces by inverse dynamics.

The unknowns are the nodes (`coordinates.Nodes`) and the duration T:

    minimise  T + w sum_i int tau_i^2 dt      (Dressler 2012, section 3.5)

Reference: Betts 2010, ch. 4; Rao 2009. IPOPT (Waechter & Biegler 2006) solves it with casadi's exact derivatives.

The program has limits, loop closures and costs at each place, and linear equations between places and nodes. The forces of a
fully actuated robot follow from its motion (it is flat), so no differential equation of the dynamics is integrated:
`tau = f(q, v, a)` is within its limits at every node and half-way between.

Constraints and cost act place by place, and the derivatives use this structure. The arguments of all places are linear in the
unknowns, `u = A w`. With `J_k` and `H_k` the derivatives at one place,

    Jacobian = diag(J_k) A,   Hessian of the Lagrangian = A' diag(H_k) A,

need one small function at every place and two sparse products. Without this structure, casadi colours the whole program's
Hessian, which takes several times as long (measured in docs/explanation/control.md).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.control.motion.coordinates import Coordinates, Nodes
from tau_dyn.control.motion.expressions import ForceLaw, import_casadi
from tau_dyn.control.motion.limits import MotionLimits


class Pointwise:
    """The function `point(u) -> (kept, residual, cost)` at all places, with derivatives."""

    def __init__(self, point: Any, A: Any, share: np.ndarray) -> None:
        """Prepare.

        Args:
            point: casadi function of one place's arguments (m,).
            A: Matrix of all places' arguments, place by place, by the unknowns.
            share: Weight of each place's cost (M,).
        """
        ca = import_casadi()
        self._A, self._share, self._n = A, ca.DM(share), len(share)
        self.width = point.numel_in(0)
        u, weight = ca.MX.sym("u", self.width), ca.MX.sym("weight")
        if point.is_a("SXFunction"):
            u, weight = ca.SX.sym("u", self.width), ca.SX.sym("weight")
        kept, residual, cost = point(u)
        kind = type(u)
        lam = [kind.sym("lam_kept", kept.numel()), kind.sym("lam_residual", residual.numel())]
        total = weight * cost + ca.dot(lam[0], kept) + ca.dot(lam[1], residual)
        self._values = point.map(self._n)
        self._slopes = [ca.Function("slope", [u], [ca.jacobian(part, u)]) for part in (kept, residual)]
        self._curvature = ca.Function("curvature", [u, weight, *lam], [ca.hessian(total, u)[0]])

    def points(self, w: Any) -> Any:
        """Return all places' arguments (m, M)."""
        return import_casadi().reshape(import_casadi().mtimes(self._A, w), self.width, self._n)

    def kept(self, w: Any) -> Any:
        """Return the quantities that are kept within -1 and 1, place by place."""
        return import_casadi().vec(self._values(self.points(w))[0])

    def residual(self, w: Any) -> Any:
        """Return the residuals that must be zero, place by place."""
        return import_casadi().vec(self._values(self.points(w))[1])

    def cost(self, w: Any) -> Any:
        """Return the sum of the places' costs."""
        return import_casadi().mtimes(self._values(self.points(w))[2], self._share)

    def kept_slope(self, w: Any) -> Any:
        """Return the derivative of `kept` by the unknowns."""
        return self._by_unknowns(self._slopes[0], w)

    def residual_slope(self, w: Any) -> Any:
        """Return the derivative of `residual` by the unknowns."""
        return self._by_unknowns(self._slopes[1], w)

    def derivatives(self, w: Any, g: Any, slopes: Sequence[Any], sizes: Sequence[int]) -> dict[str, Any]:
        """Return the solver's options that bring the program's derivatives.

        Args:
            w: Unknowns.
            g: All constraints: `kept`, `residual`, linear ones.
            slopes: Their derivatives, block by block.
            sizes: Number of rows of each block.
        """
        ca = import_casadi()
        none = ca.MX.sym("p", 0, 1)
        first = ca.Function("nlp_jac_g", [w, none], [g, ca.vertcat(*slopes)], ["x", "p"], ["g", "jac_g_x"])
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", int(sum(sizes)))
        edges = np.concatenate([[0], np.cumsum(sizes)]).tolist()
        multipliers = [ca.reshape(lam_g[edges[k] : edges[k + 1]], sizes[k] // self._n, self._n) for k in (0, 1)]
        blocks = self._curvature.map(self._n)(self.points(w), lam_f * self._share.T, *multipliers)
        H = ca.mtimes(self._A.T, ca.mtimes(self._diagonal(blocks, self._curvature), self._A))
        names = ["x", "p", "lam_f", "lam_g"]
        second = ca.Function("nlp_hess_l", [w, none, lam_f, lam_g], [ca.triu(H)], names, ["triu_hess_gamma_x_x"])
        return {"jac_g": first, "hess_lag": second}

    def _by_unknowns(self, slope: Any, w: Any) -> Any:
        return import_casadi().mtimes(self._diagonal(slope.map(self._n)(self.points(w)), slope), self._A)

    def _diagonal(self, blocks: Any, function: Any) -> Any:
        """Return blocks in a row as a block-diagonal matrix: the same nonzeros in the same order."""
        ca = import_casadi()
        return ca.MX(ca.diagcat(*[function.sparsity_out(0)] * self._n), blocks.nz[:])


_SMALL = 1e-4
"""Cost of full force of all drives, as a share of the duration. In the shortest time, forces are undetermined while one drive
limits the robot; without any preference the solver wanders there. The cost lengthens a motion by this share at most."""


def build_point_constraint(law: ForceLaw, coordinates: Coordinates, limits: MotionLimits, weight: float) -> Any:
    """Return the casadi function of one place `u = (x, x', x'', p, y, T)`: limited quantities, residuals, cost rate."""
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
    """Return the weighted squares of forces, and of their share of the limits with a weight too small to cost time."""
    small = _SMALL / len(limit) / limit**2  # zero for a joint without a limit
    return import_casadi().dot(import_casadi().DM(weight + small), tau**2)


def build_jerk_constraints(coordinates: Coordinates, limits: MotionLimits, pointwise: Pointwise, W: Any, N: int) -> Any:
    """Return the jerks between nodes and middles as shares of their limits; no rows without limits."""
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
    """Return residuals that are zero if positions and speeds follow from the accelerations."""
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
    """Return the limited quantities: pairs of quantity ('force', 'speed', 'acceleration') and joint index."""
    quantities = ("force", "speed", "acceleration")
    return [(name, int(k)) for name in quantities for k in np.flatnonzero(np.isfinite(getattr(limits, name)))]


_MIN_STEP_S = 1e-3  # [s]
_MAX_SOLVER_S = 90.0  # s; motions that are found at all take 1 to 30 s
_MIN_PIVOT = 0.01
"""Relative size of a pivot, MUMPS' own default. IPOPT's default of 1e-6 loses digits if loops are solved together with the
motion: signs of eigenvalues are wrong, IPOPT treats convex steps as nonconvex, and converges slowly (the delta with all rods: 500
iterations without an answer instead of 44)."""
_WARM = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-5,
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
}


@dataclass(frozen=True, eq=False)
class TranscriptionSolution:
    """Result of the solver.

    Attributes:
        nodes: The motion.
        status: Status reported by IPOPT.
        ok: Whether it is a solution.
        iterations: IPOPT's iterations.
        objective: `T + w int tau^2 dt`.
        seconds: Wall time.
        multipliers: Multipliers of bounds and of constraints, from which the next iteration starts.
    """

    nodes: Nodes
    status: str
    ok: bool
    iterations: int
    objective: float
    seconds: float
    multipliers: tuple[Any, Any]


class Transcription:
    """One program, to be solved from one or more starts.

    Attributes:
        limited: Quantities that are kept within -1 and 1 at nodes and middles: pairs of quantity and joint index.
    """

    def __init__(
        self, law: ForceLaw, coordinates: Coordinates, limits: MotionLimits, nodes: int, weight: float
    ) -> None:
        """Build the program.

        Args:
            law: The forces.
            coordinates: Coordinates of the motion.
            limits: Limits of the motion.
            nodes: Number N of intervals.
            weight: Weight of the squared forces [s per N^2 s].
        """
        ca = import_casadi()
        self.N, self._coordinates, self.limited = nodes, coordinates, list_limited_quantities(limits)
        sizes = [(coordinates.n, nodes + 1)] * 3 + [(k, 2 * nodes + 1) for k in (law.n_passive, law.n_inner)]
        parts = [ca.SX.sym(name, *size) for name, size in zip(("x", "dx", "ddx", "p", "y"), sizes, strict=True)]
        x, dx, ddx, p, y = parts
        w = ca.vertcat(*(ca.vec(part) for part in parts), ca.SX.sym("T"))
        places = ca.vertcat(*insert_middles(x, dx, ddx, nodes), p, y, ca.repmat(w[-1], 1, 2 * nodes + 1))
        pointwise = Pointwise(
            build_point_constraint(law, coordinates, limits, weight),
            compute_slope(places, w),
            compute_simpson_weights(nodes),
        )
        steps = compute_slope(build_integration_constraints(x, dx, ddx, nodes), w)
        W = ca.MX.sym("w", w.numel())
        jerk = build_jerk_constraints(coordinates, limits, pointwise, W, nodes)
        rows = [pointwise.kept(W), pointwise.residual(W), ca.mtimes(steps, W), jerk]
        self._sizes = [row.numel() for row in rows]
        g = ca.vertcat(*rows)
        program = {"x": W, "f": W[-1] + pointwise.cost(W), "g": g}
        slopes = [pointwise.kept_slope(W), pointwise.residual_slope(W), steps]
        more = {} if jerk.numel() else pointwise.derivatives(W, g, slopes, self._sizes)
        self._cold = ca.nlpsol("motion", "ipopt", program, _options() | more)
        self._warm = ca.nlpsol("motion", "ipopt", program, _options() | _WARM | more)

    def loose(self) -> np.ndarray:
        """Return the share of its limit (2 N + 1, m) that each limited quantity may use at each place: all."""
        return np.ones((2 * self.N + 1, len(self.limited)))

    def solve(self, start: Nodes) -> TranscriptionSolution:
        """Return the motion that IPOPT finds from a start."""
        return self._solved(self._cold, start, self.loose())

    def again(self, found: TranscriptionSolution, share: np.ndarray) -> TranscriptionSolution:
        """Return the motion within shares (2 N + 1, m) of the limits, from the one found before."""
        lam_x, lam_g = found.multipliers
        return self._solved(self._warm, found.nodes, share, lam_x0=lam_x, lam_g0=lam_g)

    def _solved(self, solver: Any, start: Nodes, share: np.ndarray, **more: Any) -> TranscriptionSolution:
        rest, jerk = np.zeros(sum(self._sizes[1:3])), np.ones(self._sizes[3])
        high = np.concatenate([share.ravel(), rest, jerk])
        below, above = self._bounds(start)
        began = time.perf_counter()
        found = solver(x0=start.flat(), lbx=below, ubx=above, lbg=-high, ubg=high, **more)
        stats = solver.stats()
        return TranscriptionSolution(
            start.like(np.array(found["x"]).ravel()),
            str(stats["return_status"]),
            bool(stats["success"]),
            int(stats["iter_count"]),
            float(found["f"]),
            time.perf_counter() - began,
            (found["lam_x"], found["lam_g"]),
        )

    def _bounds(self, start: Nodes) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of all unknowns: ranges, rest at both ends, a positive duration."""
        c, found = self._coordinates, []
        for sign, edge in ((-1, c.lower), (1, c.upper)):
            free = start.like(np.full(start.flat().size, sign * np.inf))
            free.x[:] = edge
            if c.forward and sign < 0:
                free.dx[:] = 0.0
            for k, end in ((0, c.start), (-1, c.end)):
                free.x[k], free.dx[k], free.ddx[k] = end, 0.0, 0.0
            found.append(replace(free, T=_MIN_STEP_S if sign < 0 else np.inf).flat())
        return found[0], found[1]


def _options() -> dict[str, Any]:
    return {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 500,
        "ipopt.max_wall_time": _MAX_SOLVER_S,
        "ipopt.tol": 1e-8,
        "ipopt.acceptable_tol": 1e-6,
        "ipopt.mumps_pivtol": _MIN_PIVOT,
        "error_on_fail": False,
    }
