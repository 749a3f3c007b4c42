r"""How many isolated assembly modes a six-rod plate can have at most, by the points that rods share.

Rods that end in one point of the plate (or of the base, which is the same with the roles exchanged) leave fewer than
40:

- three in one point, two in another (3-2-1): three spheres meet in 2 points, and so does each next pair of distances: 8;
- three in one point (3-1-1-1): 2, then three quadrics in the quaternion's projective space, at most 8: 16;
- three pairs (2-2-2): 16 (Nanua, Waldron & Murthy 1990, IEEE Trans. Robotics and Automation 6, 438).

`experiments/assembly_modes.py` measures the same numbers on random points, and 32 for two pairs (2-2-1-1; Faugere &
Lazard 1995, Mechanism and Machine Theory 30, 765), which is not used here as a bound.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.assembly.start import N_SOLUTIONS

_BOUNDS = {(3, 2, 1): 8, (3, 1, 1, 1): 16, (2, 2, 2): 16}


def count_shared_ends(points: np.ndarray) -> tuple[int, ...]:
    """Return how many rods end in each point of (6, 3), most first; points count as one only where they are exactly equal."""
    return tuple(sorted(np.unique(points, axis=0, return_counts=True)[1].tolist(), reverse=True))


def bound_mode_count(base: np.ndarray, plate: np.ndarray) -> int:
    """Return a proven bound on the number of isolated modes of rods between points (6, 3)."""
    return min(_BOUNDS.get(count_shared_ends(points), N_SOLUTIONS) for points in (base, plate))
