"""The pieces that together tell most: one exchanged at a time, until nothing helps (Fedorov 1972)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_SWEEPS = 5  # over all places; bounds the time


def choose_by_exchange(merit: Callable[[np.ndarray], float], information: np.ndarray, number: int) -> list[int]:
    """Return the pieces, with repetition, whose information adds up to the largest merit.

    Args:
        merit: What is made large, of an information matrix (r, r): determined parameters, or causes told apart.
        information: Information of each piece (n, r, r).
        number: How many pieces are chosen.
    """
    merits = [merit(number * one) for one in information]
    chosen, best = [int(np.argmax(merits))] * number, max(merits)
    for _ in range(_SWEEPS):
        before = best
        for slot in range(number):
            rest = sum((information[k] for j, k in enumerate(chosen) if j != slot), np.zeros_like(information[0]))
            found = [merit(rest + one) for one in information]
            if max(found) > best * (1 + 1e-9):
                chosen[slot], best = int(np.argmax(found)), max(found)
        if best <= before * (1 + 1e-3):
            break
    return chosen
