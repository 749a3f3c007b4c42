"""Any tree, with or without loops: all samples at once, or one by one through Pinocchio where there are few.

A controller and a simulator ask for one sample at a time, for which Pinocchio is quicker; so are its mass matrix and bias. Trees
with joints of more than one degree of freedom (a passive ball) also take that way. Both give the same numbers.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.mechanism.batched import BatchedTree, iterate_blocks
from tau_dyn.mechanism.guide_arrays import compute_guide_force, compute_passive_rates
from tau_dyn.mechanism.pseudo_inverse import measure_column_lengths
from tau_dyn.mechanism.samplewise import SamplewiseTree
from tau_dyn.robot import Robot

_FEW = 12
"""Samples up to which one by one is quicker."""


class TreeMechanism(SamplewiseTree):
    """Dynamics of a tree with loops."""

    def __init__(self, robot: Robot) -> None:
        """Prepare for the robot's parameter values."""
        super().__init__(robot)
        self._batched = BatchedTree.of(robot, self.solver)

    def _many(self, q: np.ndarray) -> BatchedTree | None:
        """Return the batched dynamics where these positions (N, na) are many enough."""
        return self._batched if np.ndim(q) == 2 and len(q) > _FEW else None

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p); see `Mechanism.regressor`."""
        batched = self._many(q)
        return super().regressor(q, v, a) if batched is None else batched.regressor(*self._checked(q, v, a))

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); see `Mechanism.inverse_dynamics`."""
        batched = self._many(q)
        return (
            super().inverse_dynamics(q, v, a) if batched is None else batched.inverse_dynamics(*self._checked(q, v, a))
        )

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na); see `Mechanism.inertia`."""
        batched = self._many(q)
        return super().inertia(q) if batched is None else batched.inertia(*self._checked(q))

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
        batched = self._many(q)
        return (
            super().guide_force(q, v, a) if batched is None else compute_guide_force(batched, *self._checked(q, v, a))
        )

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn (N, n, 3, na); see `Mechanism.passive_rates`."""
        batched = self._many(q)
        if batched is None:
            return super().passive_rates(q)
        return tuple(pair.name for pair in self._pairs), compute_passive_rates(batched, self._pairs, *self._checked(q))

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m]; see `Mechanism.tool_position`."""
        batched = self._many(q)
        if batched is None or self.robot.tool_frame is None:
            return super().tool_position(q)
        return batched.tool(*self._checked(q))[0]

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per actuated speed (N, 3, na); see `Mechanism.tool_jacobian`."""
        batched = self._many(q)
        if batched is None or self.robot.tool_frame is None:
            return super().tool_jacobian(q)
        return batched.tool(*self._checked(q))[1]

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,); see `Mechanism.condition`."""
        batched = self._many(q)
        if batched is None or not self.robot.loops:
            return super().condition(q)
        (q,) = self._checked(q)
        found = []
        for part in iterate_blocks(len(q)):
            J = batched.loops.jacobian(batched.loops.close(q[part]).at)
            s = np.linalg.svd(J / measure_column_lengths(J)[:, None, :], compute_uv=False)
            singular = s[:, -1] <= 1e-10 * s[:, 0]
            found.append(np.divide(s[:, 0], s[:, -1], out=np.full(len(s), np.inf), where=~singular))
        return np.concatenate(found)
