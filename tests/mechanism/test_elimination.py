"""Elimination planned once solves every system of its pattern, and says where it cannot be trusted."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.mechanism.small_systems import Elimination

PATTERN = {(0, 0), (0, 1), (1, 1), (1, 2), (2, 0), (2, 2), (3, 3), (3, 1)}


def systems(rng, n: int = 50):
    """Return random matrices (n, 4, 4) of one pattern and their entries."""
    A = np.zeros((n, 4, 4))
    for r, c in PATTERN:
        A[:, r, c] = rng.uniform(0.5, 2, n) * (3.0 if r == c else 1.0)
    return A, {(r, c): A[:, r, c].copy() for r, c in PATTERN}


def test_both_systems_are_solved_like_lapack(rng) -> None:
    """`A x = b` and `A' x = b` to rounding, for several right-hand sides."""
    A, entries = systems(rng)
    factor = Elimination.plan(PATTERN, A[0]).factor(entries)
    b = rng.standard_normal((4, 2, 50))
    x = factor.solve(b)
    assert_allclose(np.einsum("nij,jkn->ikn", A, x), b, atol=1e-12)
    assert_allclose(np.einsum("nji,jkn->ikn", A, factor.solve_transposed(b)), b, atol=1e-12)
    assert factor.residual(x, b).max() < 1e-14


def test_a_pivot_that_vanishes_shows_in_the_residual(rng) -> None:
    """A sample whose pivot is zero must not pass for solved."""
    A, entries = systems(rng)
    plan = Elimination.plan(PATTERN, A[0])
    entries[plan.steps[0].row, plan.steps[0].column][7] = 0.0
    b = rng.standard_normal((4, 1, 50))
    factor = plan.factor(entries)
    residual = factor.residual(factor.solve(b), b)
    assert not residual[7] < 1e-12
    assert np.delete(residual, 7).max() < 1e-12


def test_a_singular_reference_has_no_plan() -> None:
    """Two equal rows leave no pivot."""
    A = np.ones((2, 2))
    assert Elimination.plan({(0, 0), (0, 1), (1, 0), (1, 1)}, A) is None
