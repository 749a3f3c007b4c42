"""Starts of Newton's method that depend on a sample's own positions alone: what was found at the middle of its cell.

The space of actuated positions is cut into cells. Their middles are walked to from home in small steps, which selects home's
assembly mode, and are kept with the slope there. In which order, block or process samples come changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

_KEPT = 200_000  # cells kept at most

Learn = Callable[[np.ndarray], Iterable[tuple[np.ndarray, ...]]]
"""From cells' numbers (n, na) to what is kept of each."""


class CellStarts:
    """The cells of one robot."""

    def __init__(self, size: np.ndarray, most: int, learn: Learn) -> None:
        """Start with none.

        Args:
            size: Of a cell, one an actuator (na,) [m or rad].
            most: Cells from home beyond which positions are taken for a mistake of units; `learn` gives nan there.
            learn: Walks to the middles of new cells.
        """
        self.size, self._most, self._learn = size, most, learn
        self._known: dict[tuple[int, ...], tuple[np.ndarray, ...]] = {}

    def find(self, away: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the cells' middles and what is kept of them, samples last, at distances from home (na, N)."""
        index = np.round(away / self.size[:, None])
        whole = np.where(np.abs(index) <= self._most, index, self._most + 1).astype(np.int64)
        names, which = _find_unique_columns(whole)
        if len(self._known) > _KEPT:
            self._known.clear()
        new = names[[tuple(name) not in self._known for name in names.tolist()]]
        if len(new):
            self._known |= zip(map(tuple, new.tolist()), self._learn(new), strict=True)
        found = zip(*(self._known[tuple(name)] for name in names.tolist()), strict=True)
        return whole * self.size[:, None], *(np.stack(part, axis=-1)[..., which] for part in found)


def _find_unique_columns(whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distinct columns (n, na) of integers (na, N) and which one each sample has (N,)."""
    if np.all(whole == whole[:, :1]):
        return whole[:, :1].T, np.zeros(whole.shape[1], int)
    low = whole.min(axis=1)
    spans = (whole.max(axis=1) - low + 1).tolist()
    key, factor = np.zeros(whole.shape[1], np.int64), 1
    for row, start, span in zip(whole, low, spans, strict=True):
        key += (row - start) * factor
        factor *= int(span)
    if factor > 2**62:
        names, which = np.unique(whole.T, axis=0, return_inverse=True)
        return names, which.ravel()
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return whole[:, first].T, which.ravel()
