r"""The simplified Gantry-Tau's kinematics for many samples at once; arrays have components first and samples last.

The rows `d_i` of `D` are the rods, so `D^-1 = [d_2 x d_3, d_3 x d_1, d_1 x d_2] / det D` in rows of N; see `gantry_tau.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism.tree_arrays import compute_cross_product

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


def intersect(A: np.ndarray, lengths: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Intersect spheres around three carts `A` (3, 3, N).

    Returns:
        The tool (3, N) [m] on one side of the carts' plane, and its squared height over it relative to the plane's normal
        (N,), which is negative where the spheres do not meet.
    """
    u: np.ndarray = A[1] - A[0]
    w: np.ndarray = A[2] - A[0]
    normal = compute_cross_product(u, w)
    n2, L2 = compute_dot_products(normal, normal), lengths**2
    p = (0.5 / n2) * (compute_dot_products(u, u) + (L2[0] - L2[1]))
    r = (0.5 / n2) * (compute_dot_products(w, w) + (L2[0] - L2[2]))
    foot = p * compute_cross_product(w, normal) + r * compute_cross_product(normal, u)
    height2 = (L2[0] - compute_dot_products(foot, foot)) / n2
    with np.errstate(invalid="ignore"):
        return A[0] + foot + side * np.sqrt(height2) * normal, height2


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


def compute_dot_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of vectors (3, N)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def compute_weighted_sum(constant: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of a constant (3,) and vectors (3, N), without multiplying by zeros."""
    out = np.zeros(x.shape[1])
    for c, row in zip(constant, x, strict=True):
        if c != 0.0:
            out += row if c == 1.0 else c * row
    return out
