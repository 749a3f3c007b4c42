r"""Trees with loops on expressions: the gap of every loop, the passive joints' motion from the drives', the tool.

    J_p v_p = -J_a v_a,   J_p a_p = -(J_a a_a + gamma),   tau_a = tau(active) - J_a' J_p^-T tau(passive)

with `gamma` the gap's acceleration without joint accelerations: three solves with one factored matrix, and no more. Where
rows repeat each other (a planar linkage closed by a ball) or a joint moves nothing (a rod's spin), rows and joints that say
nothing at home are left out; what is left is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import qr

from tau_dyn.codegen.tracing import TracedFunction, compute_cross_product, trace_function
from tau_dyn.codegen.tree import LinkMotion, Tree, remove_rounding
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import Robot

_RANK = 1e-8  # pivots relative to the largest; less counts as zero


@dataclass(frozen=True, eq=False)
class ClosureExpressions:
    """The loops' equations on expressions.

    Attributes:
        gap: All equations (3 * loops,) [m].
        jacobian: Their derivative by every joint (3 * loops, nv).
        drift: Their acceleration without joint accelerations (3 * loops,); zeros unless speeds were given.
    """

    gap: np.ndarray
    jacobian: np.ndarray
    drift: np.ndarray


class FramePlace(NamedTuple):
    """A frame in base axes: place (3,) [m], rotation (3, 3), and its velocity and turning by every joint (3, nv)."""

    p: np.ndarray
    R: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


def locate_frame(tree: Tree, frame: pin.Frame, places: list[tuple[np.ndarray, np.ndarray]]) -> FramePlace:
    """Return where a frame is and how it moves, with the links' places (`Tree.places`)."""
    k = frame.parentJoint - 1
    R, p = places[k] if k >= 0 else (np.eye(3), np.zeros(3))
    at = p + R @ remove_rounding(frame.placement.translation)
    linear, angular = np.zeros((2, 3, len(tree.joints)), dtype=object)
    for j in tree.chain(k):
        axis = places[j][0] @ tree.joints[j].axis
        slides = tree.joints[j].slides
        linear[:, j] = axis if slides else compute_cross_product(axis, at - places[j][1])
        angular[:, j] = 0.0 if slides else axis
    return FramePlace(at, R @ remove_rounding(frame.placement.rotation), linear, angular)


class Loops:
    """The loops of one robot, and which equations and joints close them.

    Attributes:
        active: Places of the actuated joints in the tree.
        passive: Places of the passive joints that are solved for.
        rows: The equations that are solved, as many.
        home: Positions of all joints where the robot stands at home (nv,) [m or rad].
    """

    def __init__(self, robot: Robot, tree: Tree) -> None:
        """Choose equations and joints at home."""
        self.robot, self.tree, self._solver = robot, tree, LoopSolver(robot)
        self.active = [tree.index(name) for name in robot.actuated]
        others = [k for k in range(len(tree.joints)) if k not in self.active]
        self.home = self.closed(robot.home)
        J = np.array(self.closure(self.home).jacobian[:, others], float)
        size = np.abs(J).max(initial=1e-300)
        R, order = _pivoted(J)
        rank = int(np.sum(np.abs(np.diag(R)) > _RANK * size))
        self.passive = sorted(others[k] for k in order[:rank])
        kept = np.array(self.closure(self.home).jacobian[:, self.passive], float)
        self.rows = sorted(int(k) for k in _pivoted(kept.T)[1][:rank])

    def closed(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (nv,) at actuated positions (na,), solved in Python."""
        model, full = self.robot.model, self._solver.close(q)
        out = []
        for j in range(1, model.njoints):
            at = full[model.joints[j].idx_q :]
            out.append(np.arctan2(at[1], at[0]) if model.joints[j].nq == 2 else at[0])
        return np.array(out)

    def full(self, active: Any, passive: Any) -> list[Any]:
        """Return one position a joint; joints that are not solved for stay at home's."""
        return spread_over_joints(list(self.home), (self.active, active), (self.passive, passive))

    def rates(self, active: Any, passive: Any) -> list[Any]:
        """Return one speed or acceleration a joint; joints that are not solved for rest."""
        return spread_over_joints([0.0] * len(self.tree.joints), (self.active, active), (self.passive, passive))

    def closure(self, q: Any, v: Any = None) -> ClosureExpressions:
        """Return the loops' equations at positions and, for the drift, speeds of all joints."""
        tree = self.tree
        still = [0.0] * len(tree.joints)
        motions = tree.motions(q, still if v is None else v, still, np.zeros(3))
        places = tree.places(motions)
        gap, jacobian, drift = [], [], []
        for loop in self.robot.loops:
            a, b = (self._point(frame, motions, places) for frame in (loop.frame_a, loop.frame_b))
            for out, x, y in zip((gap, jacobian, drift), a, b, strict=True):
                out.append(x - y)
        return ClosureExpressions(*(np.concatenate(x) for x in (gap, jacobian, drift)))

    def _point(self, frame: int, motions: list[LinkMotion], places: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return place (3,), Jacobian (3, nv) and acceleration (3,) of a frame's origin, in base axes."""
        about: pin.Frame = self.robot.model.frames[frame]
        at, k, r = locate_frame(self.tree, about, places), about.parentJoint - 1, about.placement.translation
        if k < 0:
            return at.p, at.linear, np.zeros(3)
        m = motions[k]
        turning = compute_cross_product(m.w, compute_cross_product(m.w, r))
        return at.p, at.linear, places[k][0] @ (m.c + compute_cross_product(m.dw, r) + turning)

    def trace_closure(self, q: np.ndarray) -> TracedFunction:
        """Return `gap`, and `J`, the derivative of the chosen equations by the solved joints, of drives `q` and joints `p`."""

        def closure(q: Any, p: Any) -> dict[str, Any]:
            at = self.closure(self.full(q, p))
            return {"gap": at.gap, "J": at.jacobian[np.ix_(self.rows, self.passive)]}

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


class TreeExpressions:
    """A tree's joints in the order of the export: drives first, then the passive joints that are solved for.

    Attributes:
        loops: The loops, or None.
        passive: Places of the solved joints in the tree.
    """

    def __init__(self, robot: Robot) -> None:
        """Choose the equations that close the loops at home."""
        self.robot, self.tree = robot, Tree(robot)
        self.loops = Loops(robot, self.tree) if robot.loops else None
        self.active = [self.tree.index(name) for name in robot.actuated]
        self.passive = [] if self.loops is None else self.loops.passive
        assert robot.tool_frame is not None
        self._frame: pin.Frame = robot.model.frames[robot.tool_frame]
        carriers = [robot.model.names[k] for k in robot.model.supports[self._frame.parentJoint].tolist()]
        if following := [joint for joint in robot.mimics if joint in carriers]:
            raise InputError(
                "unsupported",
                f"{robot.source}: {', '.join(following)} follows another joint and carries the tool",
            )

    def place(self, q: Any, z: Any) -> list[Any]:
        """Return one position a joint of the tree."""
        rest = [0.0] * len(self.tree.joints) if self.loops is None else list(self.loops.home)
        return spread_over_joints(rest, (self.active, q), (self.passive, z))

    def gaps(self, q: Any, z: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the solved equations' gaps (np,) [m] and their derivatives (np, na + np)."""
        assert self.loops is not None
        closure = self.loops.closure(self.place(q, z))
        return closure.gap[self.loops.rows], closure.jacobian[np.ix_(self.loops.rows, [*self.active, *self.passive])]

    def tool(self, q: Any, z: Any) -> FramePlace:
        """Return the tool's pose, and its velocity and turning by drives and solved joints (3, na + np)."""
        still = [0.0] * len(self.tree.joints)
        motions = self.tree.motions(self.place(q, z), still, still, np.zeros(3))
        at, order = locate_frame(self.tree, self._frame, self.tree.places(motions)), [*self.active, *self.passive]
        return FramePlace(at.p, at.R, at.linear[:, order], at.angular[:, order])
