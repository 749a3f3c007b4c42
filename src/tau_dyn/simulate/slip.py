"""Sharp Coulomb friction of several coupled joints in one time step: each slips forwards, slips backwards, or sticks.

With `u` the velocity after the step, `f` the friction force, `A = dt M^-1` and `free` the velocity without friction,

    u = free - A f,   f_i = upper_i where u_i > 0,   f_i = lower_i where u_i < 0,   lower_i <= f_i <= upper_i where u_i = 0.

This box complementarity problem has one solution where A is symmetric and positive definite. Mostly the old direction of
motion is the answer; else projected Gauss-Seidel finds who sticks, and a linear solve makes those velocities exactly
zero. Reference: Moreau 1988; Stewart & Trinkle 1996; Jourdan, Alart & Jean 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_SWEEPS = 500  # Gauss-Seidel sweeps over the contacts at most; tens are usual
_TOLERANCE = 1e-11  # of the largest friction force


class Slip(NamedTuple):
    """Velocities after the step (na,), friction forces (na,) [N or N m], and who stands still (na,)."""

    u: np.ndarray
    force: np.ndarray
    stuck: np.ndarray


def solve_slip(A: np.ndarray, free: np.ndarray, lower: np.ndarray, upper: np.ndarray, guess: np.ndarray) -> Slip:
    """Solve the step; `lower <= upper` (na,), and `guess` (na,) is a friction force near the answer."""
    u = free - A @ guess
    wrong = ((u > 0) & (guess != upper)) | ((u < 0) & (guess != lower)) | ((u == 0) & (lower < upper))
    if not wrong.any():
        return Slip(u, guess, np.zeros(len(u), dtype=bool))
    force = np.array(_gauss_seidel(A.tolist(), free.tolist(), lower.tolist(), upper.tolist(), guess.tolist()))
    stuck = (force > lower) & (force < upper)
    if stuck.any():
        sliding = ~stuck
        rest = free[stuck] - A[np.ix_(stuck, sliding)] @ force[sliding]
        force[stuck] = np.linalg.solve(A[np.ix_(stuck, stuck)], rest)
    u = free - A @ force
    u[stuck] = 0.0
    return Slip(u, force, stuck)


def _gauss_seidel(
    A: list[list[float]], free: list[float], lower: list[float], upper: list[float], force: list[float]
) -> list[float]:
    """Return the forces after projected Gauss-Seidel sweeps; floats in lists are faster than arrays of three numbers."""
    joints = range(len(free))
    enough = _TOLERANCE * max(max(map(abs, lower)), max(map(abs, upper)), 1e-12)
    for _ in range(_SWEEPS):
        largest = 0.0
        for i in joints:
            row = A[i]
            u = free[i] - sum(row[j] * force[j] for j in joints)
            new = min(max(force[i] + u / row[i], lower[i]), upper[i])
            largest = max(largest, abs(new - force[i]))
            force[i] = new
        if largest <= enough:
            break
    return force
