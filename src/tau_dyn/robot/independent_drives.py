"""More drives than freedoms: which drives place the robot, and which follow them through the loops.

The motions that the loops permit are the null space `Z` of the gaps' derivative, `dp_A - dp_B = J v`, `J Z = 0`. The drives' rows
of `Z` have as many independent columns as the drives have freedoms. The independent drives are the first ones, in the order in
which they are named, whose rows are well conditioned at home. At a dead centre drives lose freedoms that they have elsewhere, so
closures next to home are tried, too. Reference: Khalil & Dombre 2002, ch. 7; Mueller 2005, on redundantly actuated robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, islice

import numpy as np

from tau_dyn.robot.closed_home import LoopGap
from tau_dyn.robot.robot import Robot

_STEP = 0.05  # [m or rad] of the motion to a closure next to home
_CLOSURES = 3  # compared if drives seem to depend on each other
_RANK = 1e-6  # singular value relative to the largest below which motions are dependent
_FAIR = 0.3  # share of the best conditioning from which the first drives are taken
_MAX_CHOICES = 2000  # of independent drives that are compared


def find_independent_drives(robot: Robot, order: Sequence[str]) -> tuple[str, ...]:
    """Return the actuated joints that place the robot, the first independent ones of an order; all if all are independent.

    All are returned, too, if the loops cannot be closed near home.

    Args:
        robot: A robot whose actuated joints may depend on each other.
        order: Its actuated joints, the preferred ones first.
    """
    if not robot.loops or any(joint.nv != 1 for joint in robot.model.joints[1:]):
        return robot.actuated
    gap, rng = LoopGap(robot), np.random.default_rng(0)
    moved = [*map(int, robot.active_v), *map(int, robot.passive_v)]
    x = gap.solve_from_home() if len(moved) > robot.na else None
    x = gap.descend(gap.home, moved) if x is None else x
    best = np.zeros((robot.na, 0))
    for _ in range(_CLOSURES):
        if x is None:
            break
        motions = _find_motions(gap.differentiate(x, moved))
        left, s, _ = np.linalg.svd(motions[: robot.na], full_matrices=False)
        rank = int(np.sum(s > _RANK))
        if rank == robot.na:
            return robot.actuated
        best = left[:, :rank] if rank > best.shape[1] else best
        step = np.zeros_like(x)
        step[moved] = motions @ rng.standard_normal(motions.shape[1])
        x = gap.descend(gap.follow(x + _STEP * step / max(np.abs(step).max(), 1e-12)), moved)
    return _choose(robot, best, order) if best.shape[1] else robot.actuated


def _find_motions(jacobian: np.ndarray) -> np.ndarray:
    """Return the motions (n, k) that leave the gaps closed, as orthonormal columns."""
    _, s, vt = np.linalg.svd(jacobian)
    return vt[int(np.sum(s > _RANK * s.max(initial=1e-300))) :].T


def _choose(robot: Robot, motions: np.ndarray, order: Sequence[str]) -> tuple[str, ...]:
    """Return the first drives whose rows of the motions (na, m) are well conditioned, in the tree's order."""
    rows = [robot.actuated.index(name) for name in order]
    choices = list(islice(combinations(rows, motions.shape[1]), _MAX_CHOICES))
    smallest = np.array([np.linalg.svd(motions[list(choice)], compute_uv=False)[-1] for choice in choices])
    first = int(np.argmax(smallest >= _FAIR * smallest.max()))
    return tuple(robot.actuated[k] for k in sorted(choices[first]))
