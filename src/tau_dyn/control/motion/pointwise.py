r"""Constraints and cost that act place by place, with derivatives that use it.

All places' arguments are linear in the unknowns, `u = A w`. With `J_k` and `H_k` the derivatives at one place,

    Jacobian = diag(J_k) A,   Hessian of the Lagrangian = A' diag(H_k) A,

one small function evaluated at every place and two sparse products. Left to itself casadi colours the whole program's Hessian,
which costs several times as much (measured in docs/explanation/control.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tau_dyn.control.motion.expressions import import_casadi


class Pointwise:
    """What `transform_point(u) -> (kept, residual, cost)` gives at all places."""

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
        """Return what is kept within -1 and 1, place by place."""
        return import_casadi().vec(self._values(self.points(w))[0])

    def residual(self, w: Any) -> Any:
        """Return what must be zero, place by place."""
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
        """Return blocks that stand side by side as a block-diagonal matrix: the same nonzeros in the same order."""
        ca = import_casadi()
        return ca.MX(ca.diagcat(*[function.sparsity_out(0)] * self._n), blocks.nz[:])
