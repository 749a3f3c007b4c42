r"""Trees with loops on expressions: `mechanism`'s frames, gaps and tool run on symbols, and which equations close the loops.

    J_p v_p = -J_a v_a,   J_p a_p = -(J_a a_a + gamma),   tau_a = tau(active) - J_a' J_p^-T tau(passive)

with `gamma` the gap's acceleration without joint accelerations: three solves with one factored matrix, and no more. Where
rows repeat each other (a planar linkage closed by a ball) or a joint moves nothing (a rod's spin), rows and joints that say
nothing at home are left out; what is left is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import qr

from tau_dyn.codegen.tracing import TracedFunction, as_expression_array, trace_function
from tau_dyn.mechanism import (
    Frames,
    Joint,
    LoopArrays,
    LoopSolver,
    compute_frames,
    compute_motion,
    list_joints,
)
from tau_dyn.robot import Robot

_RANK = 1e-8  # pivots relative to the largest; less counts as zero


def trace_frames(joints: list[Joint], q: Any) -> Frames:
    """Return where all joints are at one position a joint."""
    return compute_frames(joints, as_expression_array(q)[:, None])


class Loops:
    """The loops of one robot, and which equations and joints close them.

    Attributes:
        active: Places of the actuated joints in the tree.
        passive: Places of the passive joints that are solved for.
        rows: The equations that are solved, as many.
        home: Positions of all joints where the robot stands at home (nv,) [m or rad].
    """

    def __init__(self, robot: Robot) -> None:
        """Choose equations and joints at home."""
        self.robot, self._joints, solver = robot, list_joints(robot.model) or [], LoopSolver(robot)
        self._arrays = LoopArrays(solver, self._joints)
        self.active = robot.active_v.tolist()
        self.home = self.closed(robot.home)
        _, jacobian = self.closure(trace_frames(self._joints, self.home))
        J = np.array(jacobian[:, solver.passive_v], float)
        size = np.abs(J).max(initial=1e-300)
        R, order = _pivoted(J)
        rank = int(np.sum(np.abs(np.diag(R)) > _RANK * size))
        self.passive = sorted(int(solver.passive_v[k]) for k in order[:rank])
        kept = np.array(jacobian[:, self.passive], float)
        self.rows = sorted(int(k) for k in _pivoted(kept.T)[1][:rank])

    def closed(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (nv,) at actuated positions (na,), solved in Python."""
        return self._arrays.positions(self._arrays.solver.close(q))

    def full(self, active: Any, passive: Any) -> list[Any]:
        """Return one position a joint; joints that are not solved for stay at home's."""
        return spread_over_joints(list(self.home), (self.active, active), (self.passive, passive))

    def rates(self, active: Any, passive: Any) -> list[Any]:
        """Return one speed or acceleration a joint; joints that are not solved for rest."""
        return spread_over_joints([0.0] * len(self.home), (self.active, active), (self.passive, passive))

    def frames(self, active: Any, passive: Any) -> Frames:
        """Return where all joints are."""
        return trace_frames(self._joints, self.full(active, passive))

    def closure(self, at: Frames) -> tuple[np.ndarray, np.ndarray]:
        """Return the loops' gaps (3 * loops,) [m] and their derivative by every joint (3 * loops, nv)."""
        gap = as_expression_array(self._arrays.gap(at)[:, 0])
        jacobian = as_expression_array(np.zeros((len(gap), len(self.home))))
        for (row, column), value in self._arrays.entries(at).items():
            jacobian[row, column] = value[0]
        return gap, jacobian

    def drift(self, at: Frames, v: Any) -> np.ndarray:
        """Return the gaps' acceleration (3 * loops,) at one speed a joint, without joint accelerations."""
        moving = compute_motion(self._joints, at, as_expression_array(v)[:, None], None, np.zeros(3))
        return as_expression_array(self._arrays.gap_acceleration(at, moving)[:, 0])

    def carried_force(self, held: Any, joint: int) -> Any:
        """Return the loops' force (3,) on what a joint carries, by its index, of the forces on the solved equations."""
        forces = as_expression_array(np.zeros(3 * len(self.robot.loops)))
        forces[self.rows] = held
        return self._arrays.carried_force(forces, joint)

    def trace_closure(self, q: np.ndarray) -> TracedFunction:
        """Return `gap`, and `J`, the derivative of the chosen equations by the solved joints, of drives `q` and joints `p`."""

        def closure(q: Any, p: Any) -> dict[str, Any]:
            gap, jacobian = self.closure(self.frames(q, p))
            return {"gap": gap, "J": jacobian[np.ix_(self.rows, self.passive)]}

        return trace_function({"q": q, "p": self.closed(q)[self.passive]}, closure)


def spread_over_joints(out: list[Any], *parts: tuple[list[int], Any]) -> list[Any]:
    """Put values at their places among the joints of a tree, and return all."""
    for places, values in parts:
        for k, x in zip(places, values, strict=True):
            out[k] = x
    return out


def _pivoted(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R and the order of columns of a QR decomposition with column pivoting."""
    found: Any = qr(A, mode="r", pivoting=True)
    return np.asarray(found[0]), np.asarray(found[1])
