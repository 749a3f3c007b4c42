r"""Forward kinematics in closed form where the rods of an arm stay parallel: rotation first, then trilateration.

Rods of one arm that are equally long and parallel carry over their arm's rotation to the plate: `A_kj - A_k1 = R (B_kj -
B_k1)` for all of them. So the rotation that turns the plate's vectors into the arms' (Kabsch 1976) is the plate's, and
with it known each arm counts as one rod of a translating plate. This is the thesis' implicit 5-DOF kinematics (4.26) of
the F1 type at `q4 = -q5`, and as well the nominal complete Gantry-Tau and the Delta. `defect` says how far the vectors
are from each other: zero where the closed form is exact, else it is a start for Newton or a check of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.poses import Poses
from tau_dyn.kinematics.positions import require_positions
from tau_dyn.kinematics.rods import Rods
from tau_dyn.kinematics.trilateration import find_side, intersect_spheres

_EQUAL = 0.01  # by how much the lengths of parallel rods may differ, relative


class Implicit(NamedTuple):
    """Poses of the tool (N) and how far the arms' vectors are from the plate's (N,) [m]."""

    poses: Poses
    defect: np.ndarray


def solve_implicit_forward(rods: Rods, q: np.ndarray) -> Implicit:
    """Return the tool's poses as if the rods of each arm were parallel.

    Args:
        rods: A free plate on three arms.
        q: Actuated positions (N, na).

    Raises:
        InputError: The rods do not form three arms of equally long ones.
    """
    q = require_positions(rods.robot, q)
    arms = _arms(rods)
    A = rods.base_points(q)
    on_base = np.concatenate([A[:, list(arm[1:])] - A[:, arm[:1]] for arm in arms], axis=1)
    on_plate = np.concatenate([rods.on_plate[list(arm[1:])] - rods.on_plate[arm[0]] for arm in arms])
    rotation = _best_rotation(on_plate, on_base)
    defect = np.linalg.norm(on_base - on_plate @ np.swapaxes(rotation, 1, 2), axis=2).max(axis=1)
    first = [arm[0] for arm in arms]
    centres = (A[:, first] - rods.on_plate[first] @ np.swapaxes(rotation, 1, 2)).transpose(1, 2, 0)
    home = rods.base_points(rods.robot.home[None])[:, first] - rods.on_plate[first] @ rods.rotation.T
    side = float(find_side(home.transpose(1, 2, 0), rods.home.position.T)[0])
    position = intersect_spheres(centres, rods.lengths[first][:, None], side).position.T
    return Implicit(rods.tool_poses(Poses(position, rotation)), defect)


def _arms(rods: Rods) -> list[list[int]]:
    """Return the rods of each arm: those on one body of equal length."""
    arms: dict[int, list[int]] = {}
    for k, carrier in enumerate(rods.numbers.carried.carrier):
        arms.setdefault(carrier, []).append(k)
    lengths = [rods.lengths[arm] for arm in arms.values()]
    unequal = any(np.ptp(length) > _EQUAL * length.mean() for length in lengths)
    if rods.translates or len(arms) != 3 or unequal or np.any(rods.numbers.slides >= 0):
        raise InputError(
            "unsupported", f"{rods.robot.source}: the closed form needs a free plate on three arms of equally long rods"
        )
    return list(arms.values())


def _best_rotation(on_plate: np.ndarray, on_base: np.ndarray) -> np.ndarray:
    """Return the rotations (N, 3, 3) that turn vectors (m, 3) into others (N, m, 3) best, by Kabsch's method."""
    u, _, vt = np.linalg.svd(np.einsum("nmi,mj->nij", on_base, on_plate))
    flip = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= flip[:, None]
    return u @ vt
