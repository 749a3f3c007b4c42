r"""One body's share of the actuated forces, per inertial number and at given numbers; arrays have samples last.

In the body's axes, with `S = [dw]x + [w]x [w]x`, the ten numbers `m, h, I` act by `F = m a + S h`, `T = h x a + I dw + w x I w`.
Written out, the six columns of `T` in `I` hold sums of `S`'s entries and of products of `w`. Reference: Khalil & Dombre 2002, 9.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.tree_arrays import Vector, add_vectors, compute_cross_product
from tau_dyn.robot import compute_inertia_matrix


class BodyMotion(NamedTuple):
    """A body in its own axes.

    Attributes:
        movers: The actuated joints that move it (n,).
        linear: Its origin's velocity per actuated speed (3, n, N).
        angular: Its angular velocity per actuated speed (3, n, N), or None where it cannot turn.
        acceleration: Its origin's acceleration minus gravity (3, N).
        turning: Its angular velocity (3, N), None for zero.
        spinning_up: Its angular acceleration (3, N), None for zero.
    """

    movers: np.ndarray
    linear: np.ndarray
    angular: Vector
    acceleration: Vector
    turning: Vector
    spinning_up: Vector

    def power(self, force: Vector, moment: Vector) -> np.ndarray:
        """Return the actuated forces (n, N) that a force and a moment (3, N) at the body ask for."""
        out = None
        for partial, acting in ((self.linear, force), (self.angular, moment)):
            if partial is not None and acting is not None:
                for row, x in zip(partial, acting, strict=True):
                    out = row * x if out is None else np.add(out, row * x, out=out)
        return np.zeros(self.linear.shape[1:]) if out is None else out


def compute_body_columns(body: BodyMotion, wanted: list[int]) -> list[np.ndarray | None]:
    """Return the actuated forces (n, N) per unit of each of the ten inertial numbers; None for zero, and for those not wanted."""
    out: list[np.ndarray | None] = [None] * 10
    a, A = body.acceleration, body.angular
    if 0 in wanted and a is not None:
        out[0] = body.power(a, None)
    S = _spin_matrix(body)
    if set(wanted) & {1, 2, 3}:
        lever = None if a is None or A is None else compute_cross_product(a[:, None], A)
        for k in range(3):
            part = None if S is None else _product([row[k] for row in S], body.linear)
            out[1 + k] = add_vectors(part, None if lever is None else lever[k])
    if S is not None and A is not None and set(wanted) & set(range(4, 10)):
        out[4:] = _inertia_columns(body, S, A)
    return out


def compute_body_wrench(body: BodyMotion, pi: np.ndarray) -> tuple[Vector, Vector]:
    """Return the force and the moment (3, N) about its origin that move a body of ten inertial numbers, in its axes."""
    m, h, a = pi[0], pi[1:4, None], body.acceleration
    force: Vector = None if a is None else m * a
    moment: Vector = None if a is None or not h.any() else compute_cross_product(np.broadcast_to(h, a.shape), a)
    S = _spin_matrix(body)
    if S is None:
        return force, moment
    force = add_vectors(force, np.stack([row[0] * pi[1] + row[1] * pi[2] + row[2] * pi[3] for row in S]))
    inertia = compute_inertia_matrix(pi)
    w, dw = body.turning, body.spinning_up
    spin = None if dw is None else inertia @ dw
    return force, add_vectors(moment, add_vectors(spin, None if w is None else compute_cross_product(w, inertia @ w)))


def compute_momentum(linear: np.ndarray, angular: Vector, pi: np.ndarray) -> tuple[np.ndarray, Vector]:
    """Return linear and angular momentum (3, N) about a body's origin, at its velocities (3, N), all in its axes."""
    if angular is None:
        return pi[0] * linear, None
    h = np.broadcast_to(pi[1:4, None], linear.shape)
    return pi[0] * linear + compute_cross_product(angular, h), compute_cross_product(
        h, linear
    ) + compute_inertia_matrix(pi) @ angular  # type: ignore[operator]


def _product(column: list[np.ndarray], partial: np.ndarray) -> np.ndarray:
    """Return the scalar products (n, N) of a vector's rows and partial velocities (3, n, N)."""
    return column[0] * partial[0] + column[1] * partial[1] + column[2] * partial[2]


def _spin_matrix(body: BodyMotion) -> list[list[np.ndarray]] | None:
    """Return the rows of `S = [dw]x + [w]x [w]x`, or None where the body does not turn."""
    if body.turning is None and body.spinning_up is None:
        return None
    zero = np.zeros((3, body.linear.shape[2]))
    x, y, z = zero if body.turning is None else body.turning
    dx, dy, dz = zero if body.spinning_up is None else body.spinning_up
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return [[-(yy + zz), xy - dz, xz + dy], [xy + dz, -(xx + zz), yz - dx], [xz - dy, yz + dx, -(xx + yy)]]


def _inertia_columns(body: BodyMotion, S: list[list[np.ndarray]], A: np.ndarray) -> list[np.ndarray]:
    """Return the actuated forces (n, N) per unit of `Ixx, Ixy, Iyy, Ixz, Iyz, Izz`."""
    zero = np.zeros((3, A.shape[2]))
    x, y, z = zero if body.turning is None else body.turning
    dx, dy, dz = zero if body.spinning_up is None else body.spinning_up
    xy, xz, yz = x * y, x * z, y * z
    moments = (
        (dx, xz, -xy),
        (-S[2][0], S[2][1], S[0][0] - S[1][1]),
        (-yz, dy, xy),
        (S[1][0], S[2][2] - S[0][0], -S[1][2]),
        (S[1][1] - S[2][2], -S[0][1], S[0][2]),
        (yz, -xz, dz),
    )
    return [A[0] * one + A[1] * two + A[2] * three for one, two, three in moments]
