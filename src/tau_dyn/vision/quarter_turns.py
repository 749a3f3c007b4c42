"""Choice among the four quarter turns of a plate of five squares: equal for both cameras, and continuous from pose to pose.

If two cameras see one plate, the turn in the second camera is the one for which all moments agree on one relative pose of the
cameras. The plate is assumed to turn by less than 45 degrees about its normal between neighbouring poses. Neighbours have the
nearest robot positions (a minimum spanning tree), or are successive images. If a step is ambiguous, the poses after it are left
out, so that they are not turned wrongly. One turn, common to all poses, remains a convention.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import distance_matrix
from scipy.spatial.transform import Rotation

from tau_dyn.vision.bundle import Plates, Views
from tau_dyn.vision.cameras import Cameras
from tau_dyn.vision.pattern import Pattern

TURNS = Rotation.from_rotvec(np.outer(np.arange(4) * np.pi / 2, [0, 0, 1])).as_matrix()
"""Quarter turns (4, 3, 3) about the plate's normal."""

_PAIRS = 30  # moments that propose a relative pose of the cameras; more would repeat it
_SCALE = 0.05
"""Disagreement [rad, and share of the distance] with inaccurate cameras; a wrong turn gives 1.6."""
_MAX_COST = 8.0  # limits the cost of a moment with a wrong tilt
_MIN_MARGIN_RAD = np.radians(30)
"""Angle by which one turn must be smaller than the others: the plate turned by less than 30 or more than 60 degrees."""
_MAX_STEP = 0.6
"""Sum of steps of robot positions [rad or m] between neighbours: a plate on revolute joints turns by no more than that."""
_MAX_STILL_ANGLE_RAD = np.radians(5)
"""Angle between orientations of a plate that only translates."""


def turn_views(views: Views, turns: np.ndarray, pattern: Pattern) -> Views:
    """Return views whose plates are turned by `turns` quarter turns (v,): corners in another order."""
    index = np.arange(pattern.n).reshape(pattern.rows, pattern.columns)
    order = np.array([np.rot90(index, k).ravel() for k in range(4)])[turns]
    spread = None if views.spread is None else np.take_along_axis(views.spread, order, 1)
    return views._replace(corners=np.take_along_axis(views.corners, order[..., None], 1), spread=spread)


def choose_view_turns(views: Views, plates: Plates, cameras: Cameras, known: bool) -> np.ndarray:
    """Return the quarter turns (v,) that make the other cameras agree with the first one.

    Args:
        views: Corners in images.
        plates: One plate for each view, in its camera's frame.
        cameras: Initial estimates, or known cameras.
        known: Whether the cameras' relative poses are known.
    """
    out = np.zeros(len(views.camera), int)
    first = {plate: k for k, plate in enumerate(views.plate) if views.camera[k] == 0}
    for c in range(1, cameras.n):
        pairs = [(first[views.plate[k]], k) for k in np.flatnonzero(views.camera == c) if views.plate[k] in first]
        if not pairs:
            continue
        here, there = np.array(pairs).T
        turned = np.einsum("pij,kjl,pml->pkim", plates.rotation[there], TURNS, plates.rotation[here])
        shift = plates.position[there][:, None] - np.einsum("pkij,pj->pki", turned, plates.position[here])
        depth = np.linalg.norm(plates.position[here], axis=1)
        proposed = np.linspace(0, len(pairs) - 1, min(_PAIRS, len(pairs))).astype(int)
        tries = [(cameras.rotation[c], cameras.position[c])] if known else []
        tries += [] if known else [(turned[p, k], shift[p, k]) for p in proposed for k in range(4)]
        costs = [_compare(turned, shift, depth, r, t) for r, t in tries]
        upright = [1e-3 * np.arccos(((np.trace(r) - 1) / 2).clip(-1, 1)) for r, _ in tries]
        best = int(np.argmin([np.minimum(cost.min(axis=1), _MAX_COST).sum() for cost in costs] + np.array(upright)))
        out[there] = costs[best].argmin(axis=1)
    return out


def _compare(turned: np.ndarray, shift: np.ndarray, depth: np.ndarray, r: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the squared distance, in units of `_SCALE`, of each moment and turn (p, 4) from a pose of the second camera."""
    angle = np.arccos(((np.einsum("pkij,ij->pk", turned, r) - 1) / 2).clip(-1, 1))
    return (angle / _SCALE) ** 2 + (np.linalg.norm(shift - t, axis=2) / (_SCALE * depth[:, None])) ** 2


def follow_turns(rotation: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orientations (k, 3, 3) that turn continuously, and the mask of poses (k,) in the largest set joined by clear steps.

    Args:
        rotation: Orientations (k, 3, 3), each up to quarter turns.
        q: Robot positions (k, na), or (k, 0) if images are in sequence.
    """
    n, out = len(rotation), rotation.copy()
    if n < 2:
        return out, np.ones(n, bool)
    pairs, far = _list_neighbours(q, n)
    angles = _measure_turns(rotation, pairs)
    order = np.sort(angles, axis=1)
    still = bool(
        _measure_turns(rotation, np.column_stack([np.zeros(n, int), np.arange(n)])).min(axis=1).max()
        < _MAX_STILL_ANGLE_RAD
    )
    clear = (order[:, 1] - order[:, 0] > _MIN_MARGIN_RAD) & (still | ~far)
    links = np.zeros((n, n))
    links[pairs[clear, 0], pairs[clear, 1]] = 1
    group = connected_components(links, directed=False)[1]
    turn = dict(zip(map(tuple, pairs.tolist()), angles.argmin(axis=1).tolist(), strict=True))
    largest = int(np.bincount(group).argmax())
    members = np.flatnonzero(group == largest)
    todo, seen = [int(members[0])], {int(members[0]): 0}
    while todo:
        i = todo.pop()
        for j in np.flatnonzero((links[i] > 0) | (links[:, i] > 0)).tolist():
            if j not in seen:
                seen[j] = (seen[i] + (turn[i, j] if (i, j) in turn else -turn[j, i])) % 4
                out[j] = rotation[j] @ TURNS[seen[j]]
                todo.append(j)
    return out, group == largest


def _list_neighbours(q: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of neighbours (n - 1, 2), and the mask of pairs with a large distance."""
    if not q.shape[1]:
        return np.column_stack([np.arange(n - 1), np.arange(1, n)]), np.zeros(n - 1, bool)
    tree = minimum_spanning_tree(distance_matrix(q, q, p=1) + 1e-9).tocoo()
    return np.column_stack([tree.row, tree.col]), tree.data > _MAX_STEP


def _measure_turns(rotation: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the angle [rad] from the first of each pair to the second with each quarter turn (m, 4)."""
    trace = np.einsum("mij,mil,klj->mk", rotation[pairs[:, 0]], rotation[pairs[:, 1]], TURNS)
    return np.arccos(((trace - 1) / 2).clip(-1, 1))
