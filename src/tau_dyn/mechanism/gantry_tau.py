"""The simplified Gantry-Tau in closed form, vectorised over samples: arrays with components first have samples last.

Arm i: a cart at `A_i = O_i + q_i e_i` on its guideway and one rod of length `L_i` to the tool `T`, which only translates;
`e_i` is as long as the cart travels per reading of its drive.
With `d_i = T - A_i`, `D` the matrix of rows `d_i` and `b_i = d_i . e_i`,

    |d_i| = L_i,   D T' = b * v,   D T'' = b * a - |T' - e_i v_i|^2,   D^-1 = [d_2 x d_3, d_3 x d_1, d_1 x d_2] / det D.

A straight rod's motion follows from its two ends, so its mass acts as the constant matrix
`[[alpha, beta], [beta, gamma]]` between them: 1/4, 1/4, 1/4 for a point at mid-rod, 1/3, 1/6, 1/3 for a uniform rod. Virtual work
with `J = D^-1 diag(b)` then gives the cart forces. For point masses and guideways along x these are equations (6.3)-(6.7)
of Dressler 2012 (Modeling and Control of Stiff Robots for Flexible Manufacturing), without their division by `dX_i`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.mechanism.frames import compute_cross_product
from tau_dyn.mechanism.mechanism import Mechanism
from tau_dyn.mechanism.sliding_plate import compute_dot_products, intersect_spheres
from tau_dyn.robot import Robot, compute_inertia_matrix

BLOCK = 2048
"""Samples computed at once, so that they stay in the processor's cache."""


class Pose(NamedTuple):
    """Where the carts put the tool.

    Attributes:
        tool: Tool position (3, N) [m].
        rods: `d_i`, from cart to tool (3 rods, 3, N).
        inverse: `D^-1` by columns: the tool's shift per unit of each rod's equation (3 rods, 3, N).
        J: Tool velocity per cart velocity, by columns (3 carts, 3, N).
        along: `b_i = d_i . e_i` (3, N).
    """

    tool: np.ndarray
    rods: np.ndarray
    inverse: np.ndarray
    J: np.ndarray
    along: np.ndarray


def compute_cart_positions(origin: np.ndarray, direction: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the carts' positions (3 carts, 3, N) [m] at `q` (3, N)."""
    return origin[:, :, None] + direction[:, :, None] * q[:, None]


def solve_pose(A: np.ndarray, tool: np.ndarray, direction: np.ndarray) -> Pose:
    """Return rods and Jacobian with the tool (3, N) at this place."""
    d: list[np.ndarray] = list(tool - A)
    crosses = np.stack(
        [compute_cross_product(d[1], d[2]), compute_cross_product(d[2], d[0]), compute_cross_product(d[0], d[1])]
    )
    inverse = crosses / compute_dot_products(d[0], crosses[0])
    along = np.stack([compute_weighted_sum(direction[i], d[i]) for i in range(3)])
    return Pose(tool, np.stack(d), inverse, inverse * along[:, None], along)


def compute_tool_acceleration(at: Pose, direction: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the tool's acceleration (3, N) at cart velocities and accelerations (3, N)."""
    velocity = at.J[0] * v[0] + at.J[1] * v[1] + at.J[2] * v[2]
    total = np.zeros_like(velocity)
    for i in range(3):
        relative = velocity - direction[i][:, None] * v[i]
        total += at.inverse[i] * (at.along[i] * a[i] - compute_dot_products(relative, relative))
    return total


def compute_weighted_sum(constant: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of a constant (3,) and vectors (3, N), without multiplying by zeros."""
    terms: list[np.ndarray] = [row if c == 1.0 else c * row for c, row in zip(constant, x, strict=True) if c != 0.0]
    out: np.ndarray = sum(terms[1:], start=terms[0]) if terms else np.zeros_like(x[0])
    return out


_FEW = 4  # samples up to which floats one by one are faster than arrays


class _Kinematics(NamedTuple):
    rods: np.ndarray  # D (N, 3, 3), one rod a row, from cart to tool
    inverse: np.ndarray  # of D
    J: np.ndarray  # (N, 3, 3), tool velocity per cart velocity
    tool_acceleration: np.ndarray  # (N, 3)


class GantryTauMechanism(Mechanism):
    """Closed-form dynamics of a robot whose file declares the simplified Gantry-Tau."""

    equations = "gantry_tau"

    def __init__(self, robot: Robot) -> None:
        """Read geometry and mass distribution from the robot's own tree."""
        super().__init__(robot)
        model, data = robot.model, robot.model.createData()
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        joints = [model.getJointId(arm.cart_joint) for arm in robot.arms]
        if not self.describes(robot):
            raise InputError(
                "unsupported",
                f"{robot.source}: the closed form needs three driven carts, rods and a plate with mass, and a tool",
            )
        self.origin = np.array([data.oMi[j].translation for j in joints])
        axes = [pin.computeJointJacobian(model, data, pin.neutral(model), j)[:3, model.joints[j].idx_v] for j in joints]
        self.scale = robot.drive_scale
        self.direction = np.array([data.oMi[j].rotation @ axis for j, axis in zip(joints, axes, strict=True)])
        self.direction *= self.scale[:, None]
        self.gravity = np.array(model.gravity.linear)
        links = {link.link: link for link in robot.links}
        self.length = np.array([self._rod_length(arm.rod_link) for arm in robot.arms])
        self.ends = np.array([self._ends(links[arm.rod_link].nominal, L)
                              for arm, L in zip(robot.arms, self.length, strict=True)])  # fmt: skip
        values = {p.name: p.value for p in robot.parameters}
        self.m_cart = np.array(
            [values[f"{arm.cart_link}.mass"] + values[f"{arm.cart_joint}.armature"] for arm in robot.arms]
        )
        self.m_rod = np.array([values[f"{arm.rod_link}.mass"] for arm in robot.arms])
        self.m_plate = values[f"{robot.plate}.mass"]
        self.m_gravity = values.get(f"{robot.plate}.gravity_mass", 0.0)
        self._side = np.sign(np.linalg.det(self._rods(robot.home[None], self._near_home(robot))[0]))

    @staticmethod
    def describes(robot: Robot) -> bool:
        """Return whether a robot has the parts the closed form speaks of, each with its mass as only parameter."""
        parts = [link for arm in robot.arms for link in (arm.cart_link, arm.rod_link)]
        masses = {link.link for link in robot.links if link.own == (0,)}
        carts = tuple(arm.cart_joint for arm in robot.arms)
        whole = len(parts) == 6 and masses == {*parts, robot.plate}
        return whole and carts == robot.actuated and robot.tool_frame is not None

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, 3, p); see `Mechanism.regressor`."""
        q, v, a = self._checked(q, v, a)
        Y = np.zeros((3, len(self.robot.parameters), len(q)))
        for start in range(0, len(q), BLOCK):
            part = slice(start, start + BLOCK)
            self._fill(Y[:, :, part], q[part], np.ascontiguousarray(v[part].T), np.ascontiguousarray(a[part].T))
        return Y.transpose(2, 0, 1)

    def _fill(self, Y: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        """Write the columns (3, p, N) at carts (N, 3), their velocities and accelerations (3, N)."""
        at = self._pose(q)
        e, g, n = self.direction, self.gravity, self.robot.parameters.names
        acceleration = compute_tool_acceleration(at, e, v, a)
        moved = np.stack([compute_dot_products(at.J[j], acceleration) for j in range(3)])  # J' T''
        weight = np.stack([compute_weighted_sum(g, at.J[j]) for j in range(3)])  # J' g
        for i, arm in enumerate(self.robot.arms):
            alpha, beta, gamma, c = self.ends[i]
            Y[i, n.index(f"{arm.cart_link}.mass")] = self.scale[i] ** 2 * a[i] - e[i] @ g
            Y[i, n.index(f"{arm.cart_joint}.armature")] = a[i]
            rod = n.index(f"{arm.rod_link}.mass")
            for j in range(3):
                Y[j, rod] = beta * a[i] * compute_weighted_sum(e[i], at.J[j]) + gamma * moved[j] - c * weight[j]
            Y[i, rod] += (
                alpha * (e[i] @ e[i]) * a[i] + beta * compute_weighted_sum(e[i], acceleration) - (1 - c) * (e[i] @ g)
            )
        Y[:, n.index(f"{self.robot.plate}.mass")] = moved - weight
        if f"{self.robot.plate}.gravity_mass" in n:
            Y[:, n.index(f"{self.robot.plate}.gravity_mass")] = -weight

    def _pose(self, q: np.ndarray) -> Pose:
        """Return where carts at `q` (N, 3) put the tool."""
        A = compute_cart_positions(self.origin, self.direction, np.ascontiguousarray(q.T))
        return solve_pose(A, np.ascontiguousarray(self._trilaterate(q).T), self.direction)

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` and `h` of one sample; see `Mechanism.mass_and_bias`."""
        A = self.origin + q[:, None] * self.direction
        D = self._tool_of(A, q) - A
        inverse, along = np.linalg.inv(D), (D * self.direction).sum(axis=1)
        J = inverse * along
        relative = J @ v - v[:, None] * self.direction
        bias = -inverse @ (relative**2).sum(axis=1)
        alpha, beta, gamma, c = self.ends.T
        e, g = self.direction, self.gravity
        coupling = e.T * (self.m_rod * beta)  # (3 axes, 3 carts)
        m_tool = self.m_plate + self.m_rod @ gamma
        moving = self.m_cart - self._armature()
        along_rail = self.m_cart + self.m_rod * alpha
        if np.any(self.scale != 1.0):
            along_rail = along_rail + (self.scale**2 - 1) * (moving + self.m_rod * alpha)
        M = np.diag(along_rail) + J.T @ (m_tool * J + coupling) + coupling.T @ J
        at_tool = m_tool * bias - (self.m_plate + self.m_gravity + self.m_rod @ c) * g
        h = J.T @ at_tool + coupling.T @ bias - (e @ g) * (moving + self.m_rod * (1 - c))
        return M, h

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m] by intersecting three spheres."""
        (q,) = self._checked(q)
        return self._trilaterate(q)

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the conditioning (N,) of the three rods' directions."""
        (q,) = self._checked(q)
        return np.linalg.cond(self._rods(q, self._trilaterate(q)) / self.length[:, None])

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per cart velocity (N, 3, 3); see `Mechanism.tool_jacobian`."""
        (q,) = self._checked(q)
        return self._jacobian(self._rods(q, self._trilaterate(q)))

    def cart_sensitivity(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per cart's displacement (N, 3, 3, 3): `d_i . (dT - dA_i) = 0` for every rod."""
        (q,) = self._checked(q)
        D = self._rods(q, self._trilaterate(q))
        return np.einsum("nxi,nik->nxik", np.linalg.inv(D), D)

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        r"""Return the force of each rod across its guideway (N, 3, 3) [N]; see `Mechanism.guide_force`.

        With `lambda_i` the force along rod i per unit of its length, the tool's balance is `D' lambda = f`. Here `f` is the
        force that accelerates and carries the plate and the rods' tool ends. A cart holds its rod with
        `m (alpha A'' + beta T'' - (1 - c) g) + lambda d`, and feels the opposite.
        """
        q, v, a = self._checked(q, v, a)
        k = self._kinematics(q, v, a)
        alpha, beta, gamma, c = self.ends.T
        e, g, tool = self.direction, self.gravity, k.tool_acceleration
        carts = a @ (e * (self.m_rod * beta)[:, None])
        weight = (self.m_plate + self.m_gravity + self.m_rod @ c) * g
        at_tool = carts + (self.m_plate + self.m_rod @ gamma) * tool - weight
        along = (at_tool[:, None, :] @ k.inverse)[:, 0]
        held = (self.m_rod * alpha)[:, None] * a[:, :, None] * e - np.outer(self.m_rod * (1 - c), g)
        held = held + (self.m_rod * beta)[:, None] * tool[:, None, :] + along[:, :, None] * k.rods
        rail = e / self.scale[:, None]
        return np.sum(held * rail, axis=2, keepdims=True) * rail - held

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return each rod's angular velocity per cart velocity (N, 3, 3, 3); see `Mechanism.passive_rates`.

        One pair a rod: the plate and the carts only translate, so both ends turn equally and a coefficient counts both.
        `w = d x (T' - A') / L^2`, without the spin about the rod, which is not driven.
        """
        (q,) = self._checked(q)
        D = self._rods(q, self._trilaterate(q))
        relative = self._jacobian(D)[:, None] - np.eye(3)[:, None, :] * self.direction[:, :, None]  # (N, rod, 3, cart)
        d, ahead, behind = D[:, :, :, None], [1, 2, 0], [2, 0, 1]
        turning = d[:, :, ahead] * relative[:, :, behind] - d[:, :, behind] * relative[:, :, ahead]  # d x relative
        turning /= (self.length**2)[:, None, None]
        return tuple(arm.rod_link.removesuffix("_link") for arm in self.robot.arms), turning

    def _jacobian(self, D: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per cart velocity (N, 3, 3) with rods (N, 3, 3)."""
        return np.linalg.inv(D) * np.einsum("nij,ij->ni", D, self.direction)[:, None, :]

    def _rods(self, q: np.ndarray, tool: np.ndarray) -> np.ndarray:
        return tool[:, None, :] - (self.origin + q[:, :, None] * self.direction)

    def _kinematics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> _Kinematics:
        at = self._pose(q)
        acceleration = compute_tool_acceleration(at, self.direction, v.T, a.T)
        D, inverse, J = at.rods.transpose(2, 0, 1), at.inverse.transpose(2, 1, 0), at.J.transpose(2, 1, 0)
        return _Kinematics(D, inverse, J, acceleration.T)

    def _trilaterate(self, q: np.ndarray) -> np.ndarray:
        """Intersect three spheres around the carts; of the two points take the one on home's side (the sign of det D)."""
        if len(q) <= _FEW:
            A = self.origin + q[:, :, None] * self.direction
            return np.array([self._tool_of(*one) for one in zip(A, q, strict=True)]).reshape(-1, 3)
        A = compute_cart_positions(self.origin, self.direction, np.ascontiguousarray(q.T))
        tool, height = intersect_spheres(A, self.length[:, None] ** 2, float(self._side))
        if not np.all(height > 0):
            self._out_of_reach(q[int(np.argmin(np.where(np.isfinite(height), height, -np.inf)))])
        return tool.T

    def _tool_of(self, A: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return what `_trilaterate` returns, of one sample (3,) with carts at `A` (3, 3): floats cost a simulator less."""
        (x, y, z), second, third = A.tolist()
        u, w = (second[0] - x, second[1] - y, second[2] - z), (third[0] - x, third[1] - y, third[2] - z)
        normal = _cross(u, w)
        n2 = _dot(normal, normal)
        one, two, three = (self.length**2).tolist()
        p, r = 0.5 * (_dot(u, u) + one - two), 0.5 * (_dot(w, w) + one - three)
        foot = [(p * i + r * j) / n2 for i, j in zip(_cross(w, normal), _cross(normal, u), strict=True)]
        height2 = (one - _dot(foot, foot)) / n2
        if not height2 > 0:
            self._out_of_reach(q)
        height = float(self._side) * height2**0.5
        return np.array(
            [x + foot[0] + height * normal[0], y + foot[1] + height * normal[1], z + foot[2] + height * normal[2]]
        )

    def _out_of_reach(self, q: np.ndarray) -> None:
        place = ", ".join(f"{j} = {x:.4g} m" for j, x in zip(self.robot.actuated, q, strict=True))
        far = np.max(np.abs(q - self.robot.home)) > 20 * self.length.max()
        hint = "; positions must be in m (are they in mm?)" if far else ""
        raise LoopClosureError(f"{self.robot.source}: the loops cannot be closed at {place}: out of reach{hint}")

    def _near_home(self, robot: Robot) -> np.ndarray:
        """Return the tool's position in the tree's neutral pose, which a robot file puts at home (1, 3)."""
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, pin.neutral(robot.model))
        return data.oMf[robot.model.getFrameId("tool")].translation[None].copy()

    def _rod_length(self, rod_link: str) -> float:
        body = self.robot.model.frames[self.robot.model.getFrameId(rod_link, pin.FrameType.BODY)].parentJoint
        for loop in self.robot.loops:
            for frame in (self.robot.model.frames[loop.frame_a], self.robot.model.frames[loop.frame_b]):
                if frame.parentJoint == body:
                    return float(np.linalg.norm(frame.placement.translation))
        raise InputError("unsupported", f"{self.robot.source}: no loop ends on {rod_link}, as the closed form needs")

    @staticmethod
    def _ends(pi: np.ndarray, length: float) -> tuple[float, float, float, float]:
        """Return alpha, beta, gamma and the centre's share of the length, from a rod's ten inertial numbers."""
        mass = pi[0] if pi[0] > 0 else 1.0
        c = float(np.linalg.norm(pi[1:4])) / (mass * length)
        gamma = float(np.linalg.eigvalsh(compute_inertia_matrix(pi))[-1]) / (
            mass * length**2
        )  # across the rod: int s^2 dm
        return 1 - 2 * c + gamma, c - gamma, gamma, c

    def _armature(self) -> np.ndarray:
        return np.array([self.robot.parameters[f"{arm.cart_joint}.armature"].value for arm in self.robot.arms])


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
