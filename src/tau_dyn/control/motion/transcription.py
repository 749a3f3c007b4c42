r"""The motion as a nonlinear program: direct collocation of coordinates over the normalised time, forces by inverse dynamics.

The unknowns are the nodes (`nodes.py`) and the duration T:

    minimise  T + w sum_i int tau_i^2 dt      (Dressler 2012, section 3.5)

Reference: Betts 2010, ch. 4; Rao 2009. IPOPT (Waechter & Biegler 2006) solves it with casadi's exact derivatives.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.control.motion.constraints import (
    Pointwise,
    build_integration_constraints,
    build_jerk_constraints,
    build_point_constraint,
    compute_simpson_weights,
    compute_slope,
    insert_middles,
    list_limited_quantities,
)
from tau_dyn.control.motion.coordinates import Coordinates
from tau_dyn.control.motion.expressions import ForceLaw, import_casadi
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.nodes import Nodes

_MIN_STEP_S = 1e-3  # [s]
_MAX_SOLVER_S = 90.0  # s; motions that are found at all take 1 to 30 s
_MIN_PIVOT = 0.01
"""Relative size of a pivot, MUMPS' own default. IPOPT's default of 1e-6 loses digits where loops are solved beside the motion:
signs of eigenvalues come out wrong, IPOPT takes a convex step for none, and creeps (the delta with all rods: 500 iterations
without an answer in place of 44)."""
_WARM = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-5,
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
}


@dataclass(frozen=True, eq=False)
class TranscriptionSolution:
    """What the solver found.

    Attributes:
        nodes: The motion.
        status: IPOPT's own word.
        ok: Whether it is a solution.
        iterations: IPOPT's iterations.
        objective: `T + w int tau^2 dt`.
        seconds: Wall time.
        multipliers: Of bounds and of constraints, to start the next round from.
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
        limited: What is kept within -1 and 1 at nodes and middles: pairs of quantity and joint index.
    """

    def __init__(
        self, law: ForceLaw, coordinates: Coordinates, limits: MotionLimits, nodes: int, weight: float
    ) -> None:
        """Build the program.

        Args:
            law: The forces.
            coordinates: What moves.
            limits: What the motion may use.
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
