r"""Kinematics in closed form on expressions: a translating plate on three rods, and drives that each move one rod of their own.

Forward: three spheres met, on home's side of the plane of their centres (thesis (4.9); `mechanism/sliding_plate.py`).
Inverse: chain by chain, home's root (`mechanism/rod_inverse.py`). Where a root or a side does not exist, a guard of
the graph says no.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tau_dyn.control.export_rods import compute_chain_points, compute_rod_gaps, compute_squared_lengths
from tau_dyn.control.export_tree import remove_rounding
from tau_dyn.control.expression_arrays import as_expression_array, compute_cross_product
from tau_dyn.control.graph import Node
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Rods, RootChain, SlidingPlate, build_chains

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
