r"""Trees with loops on expressions: `mechanism`'s frames, gaps and tool run on symbols, and which equations close the loops.

    G = [1; -J_p^-1 J_a],   v = G v_a,   a = G a_a - [0; J_p^-1 gamma],   tau_a = G' tau

with `gamma` the gap's acceleration without actuated accelerations: solves with one factored matrix. If rows repeat each
other (a planar linkage closed by a ball) or a joint has no effect (a rod's spin), the redundant rows and joints at home are
left out; the remaining system is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import qr

from tau_dyn.equations import Graph, Node, TracedFunction, as_expression_array, trace_function
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    ClosedLoops,
    Frames,
    Joint,
    LoopArrays,
    LoopSolver,
    compute_frames,
    list_joints,
)
from tau_dyn.robot import Robot

_RANK = 1e-8  # pivots relative to the largest; less counts as zero


def trace_frames(joints: list[Joint], q: Any) -> Frames:
    """Return where all joints are at one position a joint."""
    return compute_frames(joints, as_expression_array(q)[:, None])


class _Factored(NamedTuple):
    """The inverse of the chosen equations' derivative by the solved joints, as solutions with a factored matrix."""

    graph: Graph
    factor: Node
    rows: list[int]
    n_gaps: int

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p^+ b` (passive, 1) of gaps (3 * loops, 1)."""
        given = list(b[self.rows, 0])
        if not any(isinstance(x, Node) or x for x in given):
            return as_expression_array(np.zeros((len(given), 1)))
        return as_expression_array(self.graph.solved(self.factor, given))[:, None]

    def solve_transposed(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p'^+ b` (3 * loops, 1) of passive joints' forces (passive, 1); equations that are left out hold nothing."""
        out = as_expression_array(np.zeros((self.n_gaps, 1)))
        out[self.rows, 0] = self.graph.solved(self.factor, list(b[:, 0]), transposed=True)
        return out


class Loops(LoopArrays):
    """The loops of one robot, and which equations and joints close them.

    Attributes:
        passive: Places in the tree of the passive joints that are solved for.
        rows: The equations that are solved, as many.
        home: Positions of all joints at the robot's home (nv,) [m or rad].
    """

    def __init__(self, robot: Robot) -> None:
        """Choose equations and joints at home."""
        super().__init__(LoopSolver(robot), list_joints(robot.model) or [])
        self.robot, every = robot, self.passive
        self.home = self.closed(robot.home)
        _, jacobian = self.closure(trace_frames(self.joints, self.home))
        J = np.array(jacobian[:, every], float)
        size = np.abs(J).max(initial=1e-300)
        R, order = _pivoted(J)
        rank = int(np.sum(np.abs(np.diag(R)) > _RANK * size))
        self.passive: Any = sorted(int(every[k]) for k in order[:rank])
        kept = np.array(jacobian[:, self.passive], float)
        self.rows = sorted(int(k) for k in _pivoted(kept.T)[1][:rank])
        self._given: tuple[Graph, Any] | None = None

    def closed(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (nv,) at actuated positions (na,), solved in Python."""
        return self.positions(self.solver.close(q))

    def on_expressions(self, graph: Graph, passive: Any) -> Loops:
        """Return the same loops for tracing, with expressions of the solved joints' positions."""
        other = copy(self)
        other._given = graph, passive
        return other

    def close(self, q: np.ndarray) -> ClosedLoops:
        """Return the closed configuration of one sample (1, na) on expressions; see `on_expressions`."""
        assert self._given is not None
        graph, passive = self._given
        at = self.frames(q[0], passive)
        J = self.closure(at)[1]
        factor = graph.factored(J[np.ix_(self.rows, self.passive)])
        inverse = _Factored(graph, factor, self.rows, len(J))
        G = as_expression_array(np.zeros((len(self.home), len(self.active))))
        for k, joint in enumerate(self.active):
            G[joint, k] = 1.0
            G[self.passive, k] = -inverse.solve(J[:, [joint]])[:, 0]
        return ClosedLoops(as_expression_array(self.full(q[0], passive))[:, None], at, inverse, G[:, :, None])

    def full(self, active: Any, passive: Any) -> list[Any]:
        """Return one position a joint; joints that are not solved for stay at home's."""
        return spread_over_joints(list(self.home), (self.active, active), (self.passive, passive))

    def frames(self, active: Any, passive: Any) -> Frames:
        """Return where all joints are."""
        return trace_frames(self.joints, self.full(active, passive))

    def closure(self, at: Frames) -> tuple[np.ndarray, np.ndarray]:
        """Return the loops' gaps (3 * loops,) [m] and their derivative by every joint (3 * loops, nv)."""
        gap = as_expression_array(self.gap(at)[:, 0])
        jacobian = as_expression_array(np.zeros((len(gap), self.solver.model.nv)))
        for (row, column), value in self.entries(at).items():
            jacobian[row, column] = value[0]
        return gap, jacobian

    def trace_closure(self, q: np.ndarray) -> TracedFunction:
        """Return `gap`, and `J`, the derivative of the chosen equations by the solved joints, of drives `q` and joints `p`."""

        def closure(q: Any, p: Any) -> dict[str, Any]:
            gap, jacobian = self.closure(self.frames(q, p))
            return {"gap": gap, "J": jacobian[np.ix_(self.rows, self.passive)]}

        return trace_function({"q": q, "p": self.closed(q)[self.passive]}, closure)


def spread_over_joints(out: list[Any], *parts: tuple[Sequence[int] | np.ndarray, Any]) -> list[Any]:
    """Put values at their places among the joints of a tree, and return all."""
    for places, values in parts:
        for k, x in zip(places, values, strict=True):
            out[k] = x
    return out


def _pivoted(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R and the order of columns of a QR decomposition with column pivoting."""
    found: Any = qr(A, mode="r", pivoting=True)
    return np.asarray(found[0]), np.asarray(found[1])


def require_joints(robot: Robot) -> list[Joint]:
    """Return the joints of a tree whose equations can be written as code.

    Raises:
        InputError: A joint neither turns about nor slides along one axis, a joint of a robot with loops follows another, or a
            drive has a scale.
    """
    robot.require_unscaled_drives("generated code of a tree's equations")
    robot.require_fixed_base("generated code of a tree's equations")
    if robot.mimics and robot.loops:
        listed = ", ".join(robot.mimics)
        raise InputError(
            "unsupported", f"{robot.source}: {listed} follow other joints; with loops no code is written then"
        )
    joints = list_joints(robot.model)
    if joints is None:
        raise InputError("unsupported", f"{robot.source}: only hinges and slides of one axis each export")
    return joints
