r"""Trees with loops on expressions: `mechanism`'s frames, gaps and tool run on symbols, and which equations close the loops.

    J_p v_p = -J_a v_a,   J_p a_p = -(J_a a_a + gamma),   tau_a = tau(active) - J_a' J_p^-T tau(passive)

with `gamma` the gap's acceleration without joint accelerations: three solves with one factored matrix. If rows repeat each
other (a planar linkage closed by a ball) or a joint has no effect (a rod's spin), the redundant rows and joints at home are
left out; the remaining system is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.

The forces of the open tree are those of `mechanism/newton_euler.py`, on expressions.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
from scipy.linalg import qr

from tau_dyn.equations import TracedFunction, as_expression_array, trace_function
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    Frames,
    Joint,
    LoopArrays,
    LoopSolver,
    compute_frames,
    compute_motion,
    compute_tree_forces,
    list_inertial_numbers,
    list_joints,
    list_weights,
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
        home: Positions of all joints at the robot's home (nv,) [m or rad].
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
        """Return the loops' force (3,) on the bodies that a joint (by index) carries, from the forces on the solved equations."""
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


class Tree:
    """The links of one robot at values of its parameters, numbers or expressions."""

    def __init__(self, robot: Robot, value: Callable[[str], Any] | None = None) -> None:
        """Read the tree from Pinocchio's model.

        Args:
            robot: The robot.
            value: Gives a parameter's value by its name; by default the robot's number.

        Raises:
            InputError: A joint neither turns about nor slides along one axis, a joint of a robot with loops follows another, or
                a drive has a scale.
        """
        robot.require_unscaled_drives("generated code of a tree's equations")
        robot.require_fixed_base("generated code of a tree's equations")
        if robot.mimics and robot.loops:
            listed = ", ".join(robot.mimics)
            raise InputError(
                "unsupported", f"{robot.source}: {listed} follow other joints; with loops no code is written then"
            )
        model, joints = robot.model, list_joints(robot.model)
        if joints is None:
            raise InputError("unsupported", f"{robot.source}: only hinges and slides of one axis each export")
        value = value or (lambda name: robot.parameters[name].value)
        self.joints = joints
        self.pi = {joint: as_expression_array(pi) for joint, pi in list_inertial_numbers(robot, value).items()}
        self.gravity = np.array(model.gravity.linear)
        self.armature = {j: value(f"{j}.armature") for j in robot.actuated}
        self.weights = list_weights(robot, value)

    def under(self, gravity: np.ndarray) -> Tree:
        """Return the same tree under another gravity (3,) [m/s^2]."""
        other = copy(self)
        other.gravity, other.weights = gravity, self.weights if np.any(gravity) else []
        return other

    def forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        """Return each joint's force, without drive inertia, and the force of the child links on its link, in its axes (3,)."""
        x, speeds, changes = (as_expression_array(given)[:, None] for given in (q, v, a))
        found = compute_tree_forces(self.joints, (x, speeds, changes), self.pi, self.weights, self.gravity)
        still = np.zeros((3, 1), dtype=object)
        return list(found.tau[:, 0]), [(still if force is None else force)[:, 0] for force in found.beyond[1:]]
