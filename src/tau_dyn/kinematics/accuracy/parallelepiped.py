"""Appendix A.4: the error body of three rods as a parallelepiped; its faces tell in which plane the tool errs most.

The faces are orthogonal to the rods and `2 h_k` apart, `h_k` the largest component of rod k's error along the rod. The sum of the
diagonals' squares is `4 sum h_k^2 (C C')^-1_kk`, at least `4 sum h_k^2` as the rows of C have length one: rods orthogonal to each
other make the worst case smallest, as A.4 says, for unequal errors too.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.accuracy.rod_device import RodDevice, State, solve


def compute_half_heights(device: RodDevice, state: State) -> np.ndarray:
    """Return `h_k` (N, n) [m]: the sum over the sources of what each can do along rod k, had the rod it alone."""
    _, G = device.tangent(state, state.plate)
    blocks = [np.linalg.norm(G[:, :, ball], axis=2) for ball in device.balls]
    return np.sum(blocks, axis=0) if blocks else np.zeros(G.shape[:2])


def compute_half_edges(device: RodDevice, state: State) -> np.ndarray:
    """Return the tool's displacement for each rod's largest error alone (N, 3, n) [m]: columns, half of an edge."""
    C, _ = device.tangent(state, state.plate)
    n = device.freedoms
    return solve(C, np.eye(n)[None] * compute_half_heights(device, state)[:, None])[:, :3]


def compute_face_areas(edges: np.ndarray) -> np.ndarray:
    """Return the area of the faces orthogonal to each of three rods (N, 3) [m^2], for half edges (N, 3, 3); Figure 4.9."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return np.stack([4 * np.linalg.norm(np.cross(edges[:, :, i], edges[:, :, j]), axis=1) for i, j in pairs], axis=1)
