r"""A robot of rods on expressions: `mechanism`'s own equations and closed forms, run on symbols.

With `gap_k = (|d_k|^2 - l_k^2) / 2 l0_k` and `l0_k` a rod's length at zero, `G` has the derivatives by the drives and the
plate's twist in world axes. Forward in closed form: three spheres. Inverse: chain by chain, home's root.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.codegen.graph import Node
from tau_dyn.codegen.tracing import as_expression_array
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    Plate,
    RodDimensions,
    Rods,
    RootChain,
    build_chains,
    compute_closure_by_q,
    compute_cross_product,
    compute_equation_rows,
    compute_points,
    compute_squared_lengths,
    remove_rounding,
)


class RodEquations(NamedTuple):
    """Gaps (n,) [m], and their derivatives by drives and plate (n, na + 6)."""

    gap: np.ndarray
    by: np.ndarray


def compute_rod_gaps(numbers: RodDimensions, q: Any, p: Any, R: Any) -> RodEquations:
    """Return how far the rods are from closed with the plate at p (3,), R (3, 3)."""
    numbers, q = replace(numbers, on_plate=remove_rounding(numbers.on_plate)), q[:, None]
    points = compute_points(numbers.joints, numbers.carried, q)
    squares = compute_squared_lengths(numbers, q)
    at = compute_equation_rows(points, numbers.on_plate, squares, Plate(p[:, None], R[:, :, None]))
    by_q = compute_closure_by_q(numbers, q, points, at.d)[:, :, 0]
    d, moment = (as_expression_array(np.stack(rows)[:, :, 0]) for rows in (at.d, at.moment))
    scale = 1.0 / numbers.lengths
    by = np.concatenate([as_expression_array(by_q), -d, -moment], axis=1) * scale[:, None]
    return RodEquations(as_expression_array(np.stack(at.f)[:, 0]) * scale, by)


def is_closed(rods: Rods) -> bool:
    """Return whether forward kinematics has a closed form here: three rods and a plate that only translates."""
    return rods.translates and rods.n == 3 and rods.na == 3 and has_closed_inverse(rods)


def has_closed_inverse(rods: Rods) -> bool:
    """Return whether each drive moves one rod of its own and the pose determines them all."""
    whole = rods.translates or rods.na == 6
    return whole and rods.n == rods.na and all(isinstance(c, RootChain) for c in build_chains(rods))


def solve_forward(rods: Rods, q: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's place (3,) [m], rotation (3, 3) and Jacobian (3, 3) at positions (3,)."""
    p = as_expression_array(rods.engine.solve(q[:, None])[0][:, 0])  # type: ignore[union-attr]
    by = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation)).by
    J = np.linalg.inv(as_expression_array(-by[:, 3:6])) @ by[:, :3]
    place, turn = (remove_rounding(rods.rotation @ x) for x in (rods.tool.translation, rods.tool.rotation))
    return p + place, turn, np.asarray(J)


def solve_inverse(rods: Rods, p: Any, R: Any) -> list[Any]:
    """Return the drives' positions (na,) with the tool at p (3,), R (3, 3); a translating plate keeps its own rotation.

    Raises:
        InputError: The drives do not each move one rod of their own.
    """
    if not has_closed_inverse(rods):
        raise InputError("unsupported", f"{rods.robot.source}: its inverse kinematics has no closed form")
    R_plate: Any = remove_rounding(rods.rotation) if rods.translates else R @ remove_rounding(rods.tool.rotation.T)
    p_plate = p - remove_rounding(R_plate @ rods.tool.translation)
    q: list[Any] = [0.0] * rods.na
    for chain in build_chains(rods):
        assert isinstance(chain, RootChain)
        B = as_expression_array(p_plate + R_plate @ remove_rounding(rods.on_plate[chain.rods[0]]))
        q[chain.actuators[0]] = chain.solve(B[:, None], chain.home_sign)[0, 0]
    if rods.translates:
        _require_side(rods, as_expression_array(q), p_plate)
    return q


def _require_side(rods: Rods, q: Any, p: np.ndarray) -> None:
    """Ask that the plate is on home's side of a parallel singularity, so that the graph guards it."""
    at_home = rods.gap_by_pose(rods.robot.home[None], rods.home)[0, :, :3]
    D = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation)).by[:, 3:6]
    same = (D[0] @ compute_cross_product(D[1], D[2])) * float(np.sign(np.linalg.det(at_home))) > 0.0
    if isinstance(same, Node):
        bool(same)
