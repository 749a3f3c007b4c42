r"""Configuration states: on which side of its singularities a parallel robot is.

The rods' closure `gap(q, X) = 0` gives `gap_X V + gap_q v = 0`. Where `det gap_X = 0` the actuators lose hold of the
plate (parallel singularity); where a chain's block of `gap_q` is singular, the chain is stretched or folded (serial
singularity). A continuous motion changes a determinant's sign only through zero, so the signs name the state: the one
of `gap_X` the assembly, those of the blocks of `gap_q` the working mode, which is the thesis' configuration `c` (4.2).
Equal signs do not mean that two poses are connected: `regions` searches for the motion. References: Gosselin & Angeles
1990, IEEE Trans. Robotics and Automation 6, 281; Merlet 2006, ch. 6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, Rods

_NOISE = 1e-10
"""Smallest singular value, as a share of the largest, below which a determinant has no sign."""


class States(NamedTuple):
    """States at N poses.

    Attributes:
        assembly: Sign of `det gap_X` (N,); 0 on a parallel singularity.
        working: Signs of the chains' blocks of `det gap_q` (N, n_chains), as `rods.groups`; 0 on a serial
            singularity, and where a chain has more rods than actuators.
        distance: Smallest singular value of the dimensionless `gap_X` (N,): 0 on a parallel singularity.
    """

    assembly: np.ndarray
    working: np.ndarray
    distance: np.ndarray

    @property
    def names(self) -> list[str]:
        """Return each state as text, as `+ | + - +` (N)."""
        sign = {1: "+", -1: "-", 0: "0"}
        return [
            f"{sign[int(a)]} | {' '.join(sign[int(w)] for w in row)}"
            for a, row in zip(self.assembly, self.working, strict=True)
        ]


def solve_configuration_states(rods: Rods, q: np.ndarray, plate: Poses) -> States:
    """Return the states at positions (N, na) and poses of the plate (N) that fit them.

    Raises:
        InputError: The robot has not as many rods as its plate has freedoms.
    """
    parallel = compute_plate_jacobian(rods, q, plate)
    assembly, distance = _signs(parallel)
    serial = rods.gap_by_q(q, plate)
    working = [_signs(serial[:, list(rows)][:, :, list(columns)])[0] for rows, columns in rods.groups]
    return States(assembly, np.array(working, dtype=int).T, distance)


def compute_plate_jacobian(rods: Rods, q: np.ndarray, plate: Poses) -> np.ndarray:
    """Return `gap_X` (N, n, n) by the plate's twist, turns multiplied by the rods' mean distance from the plate's centre."""
    J = rods.gap_by_pose(q, plate)
    freedoms = 3 if rods.translates else 6
    if rods.n != freedoms:
        raise InputError(
            "unsupported",
            f"{rods.robot.source} has {rods.n} rods; states need as many as the plate has freedoms, {freedoms}",
        )
    if rods.translates:
        return J[:, :, :3]
    centre = rods.on_plate.mean(axis=0)
    size = np.linalg.norm(rods.on_plate - centre, axis=1).mean()
    arm = plate.rotation @ centre
    about = J[:, :, 3:] - np.cross(
        arm[:, None], J[:, :, :3]
    )  # turns about the rods' mean point, so that the frame's place is free
    return np.concatenate([J[:, :, :3], about / size], axis=2)


def _signs(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the determinants' signs (N,), 0 where rounding leaves none, and the smallest singular values (N,)."""
    if J.shape[1] != J.shape[2]:
        return np.zeros(len(J), dtype=int), np.zeros(len(J))
    values = np.linalg.svd(J, compute_uv=False)
    sign = np.sign(np.linalg.det(J)).astype(int)
    return np.where(values[:, -1] > _NOISE * values[:, 0], sign, 0), values[:, -1]
