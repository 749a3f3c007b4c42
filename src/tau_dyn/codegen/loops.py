r"""Trees with loops on expressions: `mechanism`'s frames, gaps and tool run on symbols, and which equations close the loops.

    J_p v_p = -J_a v_a,   J_p a_p = -(J_a a_a + gamma),   tau_a = tau(active) - J_a' J_p^-T tau(passive)

with `gamma` the gap's acceleration without joint accelerations: three solves with one factored matrix, and no more. Where
rows repeat each other (a planar linkage closed by a ball) or a joint moves nothing (a rod's spin), rows and joints that say
nothing at home are left out; what is left is square. Reference: Khalil & Dombre 2002, ch. 7 and 10; `mechanism/loops.py`.

A tree of links on expressions: the recursive Newton-Euler algorithm, link by link in each link's own axes.

Outwards, with `R` and `p` the place of a joint in its parent and `u` its axis,

    w = R' w_p + u qd,   w' = R' w_p' + (R' w_p) x u qd + u qdd,   c = R' (c_p + w_p' x p + w_p x (w_p x p)),

and for a slide `c += u qdd + 2 w x u qd`, where `c` starts as minus gravity. Inwards, about the joint's origin, with the
link's mass m, first moment s and inertia I,

    f = m c + w' x s + w x (w x s) + children's,   n = I w' + w x I w + s x c + children's,   tau = u . n  or  u . f.

Reference: Luh, Walker & Paul 1980; Khalil & Dombre 2002, 9.5.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import qr

from tau_dyn.codegen.tracing import TracedFunction, as_expression_array, trace_function
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    Frames,
    Joint,
    LoopArrays,
    LoopSolver,
    compute_cross_product,
    compute_frames,
    compute_motion,
    list_joints,
    remove_rounding,
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


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """A link's motion in its own axes, each (3,): turning `w`, its change `dw`, acceleration `c` of the origin, and its place.

    `R` (3, 3) and `p` (3,) lead from its axes to its parent's.
    """

    w: np.ndarray
    dw: np.ndarray
    c: np.ndarray
    R: np.ndarray
    p: np.ndarray


class Tree:
    """The links of one robot at values of its parameters, numbers or expressions."""

    def __init__(self, robot: Robot, value: Callable[[str], Any] | None = None) -> None:
        """Read the tree from Pinocchio's model.

        Args:
            robot: The robot.
            value: Gives a parameter's value by its name; by default the robot's number.

        Raises:
            InputError: A joint neither turns about nor slides along one axis or follows another beside loops, or a drive has a
                scale.
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
        self.joints, self.pi = joints, _inertial(robot, value)
        self.gravity = np.array(model.gravity.linear)
        self.armature = {j: value(f"{j}.armature") for j in robot.actuated}
        self.weights = [
            (model.frames[model.getFrameId(name.rsplit(".", 1)[0])], value(name))
            for name in robot.parameters.names
            if name.endswith(".gravity_mass")
        ]

    def without_weight(self) -> Tree:
        """Return the same tree without gravity."""
        return self.under(np.zeros(3))

    def under(self, gravity: np.ndarray) -> Tree:
        """Return the same tree under another gravity (3,) [m/s^2]."""
        other = copy(self)
        other.gravity, other.weights = gravity, self.weights if np.any(gravity) else []
        return other

    def motions(self, q: Any, v: Any, a: Any, gravity: np.ndarray) -> list[LinkMotion]:
        """Return every link's motion; q, v, a one number or node a joint, `gravity` (3,) in base axes."""
        out: list[LinkMotion] = []
        still = np.zeros(3, dtype=object)
        for k, joint in enumerate(self.joints):
            above = out[joint.parent - 1] if joint.parent else LinkMotion(still, still, -gravity, np.eye(3), still)
            u, p = joint.axis, remove_rounding(joint.offset)
            R = joint.rotation if joint.slides else remove_rounding(joint.rotation @ turn(u, q[k]))
            p = p + joint.rotation @ u * q[k] if joint.slides else p
            w, dw = R.T @ above.w, R.T @ above.dw
            c = R.T @ (
                above.c
                + compute_cross_product(above.dw, p)
                + compute_cross_product(above.w, compute_cross_product(above.w, p))
            )
            rate: np.ndarray = u * v[k]
            if joint.slides:
                c = c + u * a[k] + 2.0 * compute_cross_product(w, rate)
            else:
                dw = dw + compute_cross_product(w, rate) + u * a[k]
                w = w + rate
            out.append(LinkMotion(w, dw, c, R, p))
        return out

    def forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        """Return each joint's force, without drive inertia, and what its link's children exert on it in its axes (3,)."""
        motions = self.motions(q, v, a, self.gravity)
        pairs = [_needed(self.pi[joint.index], m) for joint, m in zip(self.joints, motions, strict=True)]
        f, n = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        down: list[np.ndarray] = [self.gravity]  # gravity in the links' axes
        for joint, m in zip(self.joints if self.weights else [], motions, strict=False):
            down.append(m.R.T @ down[joint.parent])
        for frame, mass in self.weights:
            k = frame.parentJoint - 1
            pull = down[frame.parentJoint] * -mass
            f[k], n[k] = f[k] + pull, n[k] + compute_cross_product(frame.placement.translation, pull)
        beyond = [np.zeros(3, dtype=object) for _ in self.joints]
        tau: list[Any] = [0.0] * len(self.joints)
        for k in reversed(range(len(self.joints))):
            joint, m = self.joints[k], motions[k]
            tau[k] = joint.axis @ (f[k] if joint.slides else n[k])
            if joint.parent:
                above, turned = joint.parent - 1, m.R @ f[k]
                beyond[above] = beyond[above] - turned
                f[above] = f[above] + turned
                n[above] = n[above] + m.R @ n[k] + compute_cross_product(m.p, turned)
        return tau, beyond


def _inertial(robot: Robot, value: Callable[[str], Any]) -> dict[int, np.ndarray]:
    """Return ten inertial numbers a joint, from the robot's parameter values."""
    out: dict[int, np.ndarray] = {j: np.zeros(10) for j in range(1, robot.model.njoints)}
    for link in robot.links:
        own = np.array([value(name) for name in link.names])
        out[link.joint_id] = out[link.joint_id] + link.map @ own
    return out


def turn(u: np.ndarray, angle: Any) -> np.ndarray:
    """Return the rotation by an angle about a unit axis: `1 + sin K + (1 - cos) K K` (Rodrigues)."""
    K = remove_rounding(np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]], float))
    sine, cosine = np.sin(as_expression_array([angle]))[0], np.cos(as_expression_array([angle]))[0]
    along = remove_rounding(np.outer(u, u))
    return along + (np.eye(3) - along) * cosine + K * sine


def _needed(pi: np.ndarray, m: LinkMotion) -> tuple[np.ndarray, np.ndarray]:
    """Return the force and moment (3,), (3,) about its origin that a link needs for its motion."""
    mass, s = pi[0], pi[1:4]
    inertia = np.array([[pi[4], pi[5], pi[7]], [pi[5], pi[6], pi[8]], [pi[7], pi[8], pi[9]]])
    f = m.c * mass + compute_cross_product(m.dw, s) + compute_cross_product(m.w, compute_cross_product(m.w, s))
    return f, inertia @ m.dw + compute_cross_product(m.w, inertia @ m.w) + compute_cross_product(s, m.c)
