r"""Newton's step of an underdetermined problem: closed first, then the orientation, then no more motion than needed.

    C y = -g,   minimise |T y - t|^2 + damping |(y - p) / s|^2

solved by its Karush-Kuhn-Tucker equations (Nocedal & Wright 2006, ch. 16). `C` may lose rows (redundant loops, a dead
centre): a small diagonal in their place gives least squares there instead of a singular matrix. Samples first.
"""

from __future__ import annotations

import numpy as np


def solve_least_motion_step(
    C: np.ndarray,
    gap: np.ndarray,
    turning: np.ndarray,
    turn: np.ndarray,
    weight: np.ndarray,
    pull: np.ndarray,
    softness: float,
) -> np.ndarray:
    """Return the steps `y` (N, m).

    Args:
        C: Derivatives of the closure (N, n, m).
        gap: Closure (N, n).
        turning: Derivatives `T` of the tool's rotation (N, 3, m), or of nothing (N, 0, m).
        turn: Rotation `t` that is left (N, 3 or 0) [rad].
        weight: What motion costs (m,), or (N, m or 1), small beside 1; 0 where `T` sees all of it.
        pull: Motion `p` that costs nothing (N, m).
        softness: Square root of what lost rows are worth beside the others.
    """
    n, rows, m = C.shape
    K = np.zeros((n, m + rows, m + rows))
    K[:, :m, :m] = np.swapaxes(turning, 1, 2) @ turning
    index = np.arange(m)
    K[:, index, index] += weight
    K[:, m:, :m], K[:, :m, m:] = C, np.swapaxes(C, 1, 2)
    index = np.arange(m, m + rows)
    K[:, index, index] = -(softness**2)
    right = np.empty((n, m + rows))
    right[:, :m] = np.einsum("nij,ni->nj", turning, turn) + weight * pull
    right[:, m:] = -gap
    return solve_with_pseudo_inverse(K, right)[:, :m]


def solve_with_pseudo_inverse(K: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return `K^-1 b` (N, m); of a singular matrix what its pseudo-inverse gives, nan where numbers are missing."""
    out = np.full(right.shape, np.nan)
    sound = np.isfinite(K).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    K, right = (K, right) if sound.all() else (K[sound], right[sound])
    try:
        out[sound] = np.linalg.solve(K, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        out[sound] = np.einsum("nij,nj->ni", np.linalg.pinv(K, rcond=1e-13), right)
    return out


class Progress:
    """Which samples still close: one whose gap has not shrunk for some rounds is given up, one at rest is done."""

    def __init__(self, n: int, patience: int) -> None:
        """Watch `n` samples."""
        self._reference, self._since = np.full(n, np.inf), np.zeros(n, int)
        self._patience, self._size = patience, np.full(n, np.inf)

    def stalled(self, index: np.ndarray, gap: np.ndarray) -> np.ndarray:
        """Return which of the samples at `index` have a gap (k,) that stopped shrinking (k,)."""
        better = gap < 0.6 * self._reference[index]
        self._reference[index] = np.where(better, gap, self._reference[index])
        self._since[index] = np.where(better, 0, self._since[index] + 1)
        return self._since[index] > self._patience

    def rests(self, index: np.ndarray, size: np.ndarray, done: float, near: float) -> np.ndarray:
        """Return whose step (k,) is below `done`, or below `near` and no longer shrinking: rounding (k,)."""
        floor = (size < near) & (size > 0.5 * self._size[index])
        self._size[index] = size
        return (size < done) | floor
