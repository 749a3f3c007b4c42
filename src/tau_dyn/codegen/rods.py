r"""A robot of rods on expressions: how the rods close, and kinematics in closed form.

With `d_k = A_k(q) - p - R b_k`, `l_k` the rod's length and `l0_k` that at zero,

    gap_k = (|d_k|^2 - l_k^2) / 2 l0_k,   G_k = [d_k' dA_k/dq - l_k l_k',  -d_k',  -(R b_k x d_k)'] / l0_k

by the drives and by the plate's twist in world axes, as `mechanism/frames.py` and `free_plate.py` have them on arrays. Forward
in closed form: three spheres met, on home's side of the plane of their centres (thesis (4.9); `mechanism/sliding_plate.py`).
Inverse: chain by chain, home's root (`mechanism/chain_inverse.py`). Where a root or a side does not exist, a guard says no.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.codegen.graph import Node
from tau_dyn.codegen.tracing import as_expression_array, compute_cross_product
from tau_dyn.codegen.tree import remove_rounding, turn
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import RodDimensions, Rods, RootChain, SlidingPlate, build_chains, list_path


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
        for j in list_path(numbers.joints, carrier):
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


_FLAT = 1e-12  # squared height over the centres' plane by the squared longest rod, as in sliding_plate.py


def is_closed(rods: Rods) -> bool:
    """Return whether forward kinematics has a closed form here: three rods and a plate that only translates."""
    return rods.translates and rods.n == 3 and rods.na == 3 and has_closed_inverse(rods)


def has_closed_inverse(rods: Rods) -> bool:
    """Return whether each drive moves one rod of its own and the pose determines them all."""
    whole = rods.translates or rods.na == 6
    return whole and rods.n == rods.na and all(isinstance(c, RootChain) for c in build_chains(rods))


def solve_forward(rods: Rods, q: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's place (3,) [m], rotation (3, 3) and Jacobian (3, 3) at positions (3,)."""
    plate = SlidingPlate(rods)
    centres = compute_chain_points(rods.numbers, q).at - remove_rounding(rods.on_plate @ rods.rotation.T)
    square, _ = compute_squared_lengths(rods.numbers, q)
    c, s = centres[plate.three], [square[k] for k in plate.three]
    u, w = c[1] - c[0], c[2] - c[0]
    normal = compute_cross_product(u, w)
    inverse = 1.0 / (normal @ normal)
    a, b = (inverse * 0.5) * (u @ u + (s[0] - s[1])), (inverse * 0.5) * (w @ w + (s[0] - s[2]))
    foot = compute_cross_product(w, normal) * a + compute_cross_product(normal, u) * b
    height = s[0] - foot @ foot
    _require(height > _FLAT * float(np.max(rods.lengths)) ** 2)
    p = foot + normal * (plate.side * _root(height * inverse)) + c[0]
    at = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation))
    J = np.linalg.inv(as_expression_array(-at.by[:, 3:6])) @ at.by[:, :3]
    return (
        p + remove_rounding(rods.rotation @ rods.tool.translation),
        remove_rounding(rods.rotation @ rods.tool.rotation),
        np.asarray(J),
    )


def solve_inverse(rods: Rods, p: Any, R: Any) -> list[Any]:
    """Return the drives' positions (na,) with the tool at p (3,), R (3, 3); a translating plate keeps its own rotation.

    Raises:
        InputError: The drives do not each move one rod of their own.
    """
    if not has_closed_inverse(rods):
        raise InputError("unsupported", f"{rods.robot.source}: its inverse kinematics has no closed form")
    if rods.translates:
        R_plate = remove_rounding(rods.rotation)
        p_plate = p - remove_rounding(rods.rotation @ rods.tool.translation)
    else:
        R_plate = R @ remove_rounding(rods.tool.rotation.T)
        p_plate = p - R_plate @ rods.tool.translation
    q: list[Any] = [0.0] * rods.na
    for chain in build_chains(rods):
        assert isinstance(chain, RootChain)
        B = p_plate + R_plate @ remove_rounding(rods.on_plate[chain.rods[0]])
        q[chain.actuators[0]] = _root_of(chain, B)
    if rods.translates:
        _require_side(rods, q, p_plate)
    return q


def _root_of(chain: RootChain, B: np.ndarray) -> Any:
    if chain.joint is None:
        d = B - chain.point
        square = d @ d - float(chain.offset) ** 2
        return (_root(square) - float(np.sqrt(chain.length**2 - chain.offset**2))) * float(chain.gain)
    d, o = chain.joint.direction, chain.joint.origin
    if not chain.turns:
        square, w = float(d @ d), B - (o + chain.point)
        along = (w @ d) * (1.0 / square)
        across = w - d * along
        return along + _root((float(chain.length) ** 2 - across @ across) * (1.0 / square)) * float(chain.home_sign)
    return _angle(chain, B - o)


def _angle(chain: RootChain, e: np.ndarray) -> Any:
    """Return the angle with `a cos + b sin = c` on home's side, within half a turn from home."""
    assert chain.joint is not None
    gain = float(np.linalg.norm(chain.joint.direction))
    n = chain.joint.direction / gain
    along = n * (n @ chain.point)
    a, b = e @ (chain.point - along), e @ np.cross(n, chain.point)
    c = (e @ e + float(chain.point @ chain.point - chain.length**2)) * 0.5 - e @ along
    turned = _two(np.arctan2, b, a) + _two(np.arctan2, _root(a * a + b * b - c * c), c) * float(chain.home_sign)
    away = as_expression_array([turned - chain.home * gain])
    return (_two(np.arctan2, np.sin(away)[0], np.cos(away)[0]) + chain.home * gain) * (1.0 / gain)


def _require_side(rods: Rods, q: Sequence[Any], p: np.ndarray) -> None:
    """Ask that the plate is on home's side of a parallel singularity."""
    at_home = rods.gap_by_pose(rods.robot.home[None], rods.home)[0, :, :3]
    D = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation)).by[:, 3:6]
    _require((D[0] @ compute_cross_product(D[1], D[2])) * float(np.sign(np.linalg.det(at_home))) > 0.0)


def _root(x: Any) -> Any:
    _require(x >= 0.0)
    return np.sqrt(as_expression_array([x]))[0]


def _two(function: Any, x: Any, y: Any) -> Any:
    return function(as_expression_array([x]), as_expression_array([y]))[0]


def _require(condition: Any) -> None:
    """Ask a condition, so that the graph guards it."""
    if isinstance(condition, Node):
        bool(condition)
