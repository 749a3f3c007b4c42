r"""A robot of rods on expressions: the points that its chains carry, and how the rods close.

With `d_k = A_k(q) - p - R b_k`, `l_k` the rod's length and `l0_k` that at zero,

    gap_k = (|d_k|^2 - l_k^2) / 2 l0_k,   G_k = [d_k' dA_k/dq - l_k l_k',  -d_k',  -(R b_k x d_k)'] / l0_k

by the drives and by the plate's twist in world axes, as `mechanism/frames.py` and `plate_arrays.py` have them on arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tau_dyn.control.export_tree import remove_rounding, turn
from tau_dyn.control.expression_arrays import compute_cross_product
from tau_dyn.mechanism import RodDimensions, frames


class ExpressionFrame(NamedTuple):
    """A chain joint: rotation (3, 3), place (3,) and direction (3,) in the world."""

    R: np.ndarray
    p: np.ndarray
    d: np.ndarray


class Points(NamedTuple):
    """What the chains carry: points (n, 3) and their derivatives by the drives (n, 3, na)."""

    at: np.ndarray
    by_q: np.ndarray


class RodEquations(NamedTuple):
    """Gaps (n,) [m], and their derivatives by drives and plate (n, na + 6)."""

    gap: np.ndarray
    by: np.ndarray


def trace_joint_frames(numbers: RodDimensions, q: Any) -> list[ExpressionFrame]:
    """Return every chain joint's frame at positions (na,)."""
    out: list[ExpressionFrame] = []
    for joint in numbers.joints:
        above = out[joint.parent] if joint.parent >= 0 else ExpressionFrame(np.eye(3), np.zeros(3), np.zeros(3))
        d, p = above.R @ joint.direction, above.p + above.R @ joint.origin
        if joint.slides:
            out.append(ExpressionFrame(above.R @ remove_rounding(joint.rotation), p + d * q[joint.actuator], d))
        else:
            gain = float(np.linalg.norm(joint.direction))
            R = remove_rounding(turn(joint.direction / gain, q[joint.actuator] * gain) @ joint.rotation)
            out.append(ExpressionFrame(above.R @ R, p, d))
    return out


def compute_chain_points(numbers: RodDimensions, q: Any) -> Points:
    """Return the points that the chains carry, and how they move, at positions (na,)."""
    at = trace_joint_frames(numbers, q)
    n = len(numbers.carried.carrier)
    places, by_q = np.zeros((n, 3), dtype=object), np.zeros((n, 3, len(q)), dtype=object)
    for k, carrier in enumerate(numbers.carried.carrier):
        local = numbers.carried.local[k]
        places[k] = at[carrier].p + at[carrier].R @ local if carrier >= 0 else local
        for j in frames.list_path(numbers.joints, carrier):
            joint = numbers.joints[j]
            by_q[k, :, joint.actuator] += (
                at[j].d if joint.slides else compute_cross_product(at[j].d, places[k] - at[j].p)
            )
    return Points(places, by_q)


def compute_squared_lengths(numbers: RodDimensions, q: Any) -> tuple[list[Any], np.ndarray]:
    """Return the rods' squared lengths (n,) [m^2], and half of their derivatives by the drives (n, na) [m]."""
    out: list[Any] = [float(x) ** 2 for x in numbers.lengths]
    by_q = np.zeros((len(out), len(q)), dtype=object)
    for k in np.flatnonzero(numbers.slides >= 0).tolist():
        a, gain, offset = int(numbers.slides[k]), float(numbers.gains[k]), float(numbers.offsets[k])
        reach = q[a] * gain + float(np.sqrt(numbers.lengths[k] ** 2 - offset**2))
        out[k], by_q[k, a] = reach * reach + offset**2, reach * gain
    return out, by_q


def compute_rod_gaps(numbers: RodDimensions, q: Any, p: Any, R: Any) -> RodEquations:
    """Return how far the rods are from closed with the plate at p (3,), R (3, 3)."""
    A, (square, half) = compute_chain_points(numbers, q), compute_squared_lengths(numbers, q)
    gap, by = [], np.zeros((len(square), len(q) + 6), dtype=object)
    for k, b in enumerate(numbers.on_plate):
        r, scale = R @ remove_rounding(b), 1.0 / float(numbers.lengths[k])
        d = A.at[k] - p - r
        gap.append((d @ d - square[k]) * (0.5 * scale))
        by[k] = np.concatenate([d @ A.by_q[k] - half[k], -d, -compute_cross_product(r, d)]) * scale
    return RodEquations(np.array(gap, dtype=object), by)
