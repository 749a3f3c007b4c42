r"""Loops on expressions: the gap of every loop, its Jacobian, and the passive joints' motion from the drives'.

    J_p v_p = -J_a v_a,   J_p a_p = -(J_a a_a + gamma),   tau_a = tau(active) - J_a' J_p^-T tau(passive)

with `gamma` the gap's acceleration without joint accelerations: three solves with one factored matrix, and no more. Where
rows repeat each other (a planar linkage closed by a ball) or a joint moves nothing (a rod's spin), rows and joints that say
nothing at home are left out; what is left is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.linalg import qr

from tau_dyn.control.export_tree import LinkMotion, Tree
from tau_dyn.control.expression_arrays import compute_cross_product
from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import Robot

_RANK = 1e-8  # pivots relative to the largest; less counts as zero


@dataclass(frozen=True, eq=False)
class Closure:
    """The loops' equations on expressions.

    Attributes:
        gap: All equations (3 * loops,) [m].
        jacobian: Their derivative by every joint (3 * loops, nv).
        drift: Their acceleration without joint accelerations (3 * loops,); zeros unless speeds were given.
    """

    gap: np.ndarray
    jacobian: np.ndarray
    drift: np.ndarray


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

    def closure(self, q: Any, v: Any = None) -> Closure:
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
        return Closure(*(np.concatenate(x) for x in (gap, jacobian, drift)))

    def _point(self, frame: int, motions: list[LinkMotion], places: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return place (3,), Jacobian (3, nv) and acceleration (3,) of a frame's origin, in base axes."""
        about: pin.Frame = self.robot.model.frames[frame]
        k, r = about.parentJoint - 1, about.placement.translation
        jacobian = np.zeros((3, len(motions)), dtype=object)
        if k < 0:
            return np.array(r), jacobian, np.zeros(3)
        R, p = places[k]
        place, m = p + R @ r, motions[k]
        for j in self.tree.chain(k):
            axis = places[j][0] @ self.tree.joints[j].axis
            jacobian[:, j] = axis if self.tree.joints[j].slides else compute_cross_product(axis, place - places[j][1])
        return (
            place,
            jacobian,
            R @ (m.c + compute_cross_product(m.dw, r) + compute_cross_product(m.w, compute_cross_product(m.w, r))),
        )


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
