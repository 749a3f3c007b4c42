r"""Assembly modes of a tree with loops: Newton's method on the passive joints from many starts.

With the actuated joints still, the loops `c(x_p) = 0` are solved for the passive ones by damped Gauss-Newton steps

    (J_p' J_p + mu 1) dx = -J_p' c,   mu proportional to |c|^2  (Yamashita & Fukushima 2001),

from starts drawn within the joints' limits. Two solutions are one mode where the tool's pose, the joints' origins and the
points in which loops close agree. Starts are drawn until each mode was met ten times: the chance of meeting a new one is
about the share of those met once (Good 1953). It is no proof that none is left.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism import Frames, Poses, TreePose, compute_frames

_BATCH = 100  # starts at a time
_MAX_STARTS = 3000  # of one set of actuated positions
_MIN_TIMES_MET = 10  # of each mode before the search ends, as `tree_inverse.py`
_MAX_MODES = 200  # more are a continuum
_ITERATIONS = 60  # Newton's steps from one start; nearly all that arrive do within 40
_STEP = 0.5  # [m or rad] largest step of a passive joint
_DAMPING = 1e-2  # of the squared gap, by that of the largest entry of J_p
_CLOSED = 1e-10  # [m]
_EQUALITY_TOLERANCE = 1e-6  # [m] and of rotation matrices' entries
_REGULAR = 1e-7  # singular value relative to the largest below which a passive motion leaves the loops closed
_SLIDE = 2.0  # [m] range of a passive slide without limits
_UNLIMITED = 1e5  # [m] a limit beyond this is none


class TreeModes(NamedTuple):
    """Modes found at one set of actuated positions.

    Attributes:
        tool: Poses of the tool (m).
        n_starts: Starts tried.
        n_singular: Distinct solutions dropped, in which passive joints move though the actuators stand.
    """

    tool: Poses
    n_starts: int
    n_singular: int


def search_tree_modes(engine: TreePose, q: np.ndarray, *, seed: int = 0) -> TreeModes:
    """Return the modes that many starts find.

    Args:
        engine: The robot, with at least one loop.
        q: Actuated positions (na,) [m or rad].
        seed: Of the starts.
    """
    rng, passive = np.random.default_rng(seed), engine.loops.passive
    rank = _rank(engine, engine.loops.close(engine.robot.home[None]).x)[0]
    signs: list[np.ndarray] = []
    met: list[int] = []
    regular: list[bool] = []
    poses: list[Poses] = []
    n_starts = 0
    while n_starts < _MAX_STARTS and len(signs) < _MAX_MODES:
        x = np.empty((engine.robot.model.nv, _BATCH))
        x[engine.loops.active] = q[:, None]
        x[passive] = _draw_starts(engine, rng)
        x = _close(engine, x)
        n_starts += _BATCH
        at = compute_frames(engine.joints, x)
        tool, ranks = engine.pose_of(at), _rank(engine, x)
        for k, sign in enumerate(_signatures(engine, at, tool)):
            same = next((i for i, s in enumerate(signs) if np.abs(s - sign).max() < _EQUALITY_TOLERANCE), None)
            if same is None:
                signs.append(sign)
                met.append(1)
                regular.append(bool(ranks[k] >= rank))
                poses.append(tool.take(slice(k, k + 1)))
            else:
                met[same] += 1
        if not signs or min(met) >= _MIN_TIMES_MET:
            if n_starts >= 2 * _BATCH:
                break
    kept = [p for p, ok in zip(poses, regular, strict=True) if ok]
    tool = Poses(
        np.concatenate([np.zeros((0, 3)), *(p.position for p in kept)]),
        np.concatenate([np.zeros((0, 3, 3)), *(p.rotation for p in kept)]),
    )
    return TreeModes(tool, n_starts, len(poses) - len(kept))


def _draw_starts(engine: TreePose, rng: np.random.Generator) -> np.ndarray:
    """Draw passive positions (n_passive, batch): slides within their limits, turns all the way round."""
    model, rows = engine.robot.model, {joint.v: joint for joint in engine.joints}
    out = np.empty((len(engine.loops.passive), _BATCH))
    for row, v in enumerate(engine.loops.passive):
        low, high = -np.pi, np.pi
        if rows[int(v)].slides:
            at = model.joints[rows[int(v)].index].idx_q
            ends = model.lowerPositionLimit[at], model.upperPositionLimit[at]
            low, high = (e if abs(e) < _UNLIMITED else s * _SLIDE / 2 for e, s in zip(ends, (-1, 1), strict=True))
        out[row] = rng.uniform(low, max(high, low), _BATCH)
    return out


def _close(engine: TreePose, x: np.ndarray) -> np.ndarray:
    """Return those columns of positions (nv, N) that Newton's steps brought to closed loops."""
    x, passive = x.copy(), engine.loops.passive
    left = np.arange(x.shape[1])
    closed = np.zeros(x.shape[1], bool)
    for _ in range(_ITERATIONS):
        at = compute_frames(engine.joints, x[:, left])
        gap, J = engine.loops.gap(at).T, engine.loops.jacobian(at)
        square = np.einsum("nij,nij->n", J, J)
        JT = np.swapaxes(J, 1, 2)
        damping = np.maximum(_DAMPING * np.sum(gap**2, axis=1), 1e-14 * square)
        normal = JT @ J + damping[:, None, None] * np.eye(len(passive))
        step = -np.linalg.solve(normal, JT @ gap[:, :, None])[:, :, 0]
        size = np.abs(step).max(axis=1)
        done = (np.abs(gap).max(axis=1) < _CLOSED) & (size < _CLOSED)
        closed[left[done]] = True
        step *= np.minimum(1.0, _STEP / np.maximum(size, 1e-300))[:, None]
        x[np.ix_(passive, left)] += step.T
        left = left[~done & np.isfinite(size)]
        if not left.size:
            break
    return x[:, closed]


def _rank(engine: TreePose, x: np.ndarray) -> np.ndarray:
    """Return the rank (N,) of the loops' Jacobian by the passive joints at positions (nv, N)."""
    if not x.shape[1]:
        return np.zeros(0, int)
    s = np.linalg.svd(engine.loops.jacobian(compute_frames(engine.joints, x)), compute_uv=False)
    return np.sum(s > _REGULAR * s.max(axis=1, keepdims=True), axis=1)


def _signatures(engine: TreePose, at: Frames, tool: Poses) -> np.ndarray:
    """Return what tells modes apart (N, k): the tool's pose, the joints' origins, the points where loops close."""
    n = len(tool.position)
    origins = [np.broadcast_to(at.origin[joint.index], (3, n)).T for joint in engine.joints]
    ends = [np.broadcast_to(point, (3, n)).T for point in engine.loops.closing_points(at)]
    return np.concatenate([tool.position, tool.rotation.reshape(n, 9), *origins, *ends], axis=1)
