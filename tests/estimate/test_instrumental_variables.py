"""Instrumental variables against dense algebra, and against the bias that they are there to avoid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.estimate import (
    Regression,
    RegressionRun,
    WhiteRows,
    estimate_of,
    solve_instrumental_variables,
    solve_least_squares,
)
from tau_dyn.estimate.instrumental_variables import estimate_instrumental_covariance
from tau_dyn.parameters import Parameter, Parameters

N, TRUTH = 3000, np.array([2.0, -1.0])


def problem(rng: np.random.Generator, error: float = 0.0, **known: float):
    """Return least squares on columns with errors, and white rows with the true columns as instruments; unit noise."""
    Z = rng.normal(size=(N, 2, 2))
    W = Z + error * rng.normal(size=Z.shape)
    y = Z @ TRUTH + rng.normal(size=(N, 2))
    t, all_of = np.arange(N) / 100, np.ones((N, 2), bool)
    parameters = Parameters([Parameter("a", 2.01, "1", **known), Parameter("b", 0.0, "1")])
    first = solve_least_squares(
        Regression(parameters, ("j0", "j1"), ("N", "N"), (RegressionRun("made", t, W, y, all_of, W, y),))
    )
    shares = np.stack([y * unit for unit in np.eye(2)])
    parts = (slice(0, 1100), slice(1100, N))
    rows = [WhiteRows(t[p], Z[p], W[p], y[p], shares[:, p], all_of[p]) for p in parts]
    return first, rows, (Z.reshape(-1, 2), W.reshape(-1, 2), y.ravel())


def test_it_solves_the_instruments_equations(rng):
    """`beta = (Z' W)^-1 Z' y` of all stretches stacked, residuals and all."""
    first, rows, (Z, W, y) = problem(rng, 0.3)
    solution = solve_instrumental_variables(first, rows)
    assert_allclose(solution.beta, np.linalg.solve(Z.T @ W, Z.T @ y), rtol=1e-10)
    assert_allclose(solution.J, Z.T @ W, rtol=1e-10)
    assert_allclose(np.concatenate([e.ravel() for e in solution.residuals]), y - W @ solution.beta, atol=1e-10)


def test_errors_in_columns_bias_least_squares_and_not_instruments(rng):
    """Errors of half a column's size take a fifth off least squares, `1 / (1 + 0.5^2)`; instruments keep the truth."""
    first, rows, _ = problem(rng, 0.5)
    assert_allclose(first.beta, TRUTH / 1.25, rtol=0.05)
    found = estimate_of(first, rows, solve_instrumental_variables(first, rows))
    assert np.all(np.abs(found.beta - TRUTH) < 4 * found.stderr)
    assert np.all(found.stderr < 0.03)
    assert [p.stderr for p in found.parameters] == pytest.approx(found.stderr)


def test_what_is_known_beforehand_enters_as_one_more_equation(rng):
    """A prior of 2.01 +- 0.005 is a row `a / 0.005 = 2.01 / 0.005` of unit noise, in the answer and in its error."""
    first, rows, (Z, W, y) = problem(rng, prior_stderr=0.005)
    solution, row = solve_instrumental_variables(first, rows), np.array([1 / 0.005, 0.0])
    J = Z.T @ W + np.outer(row, row)
    assert_allclose(solution.beta, np.linalg.solve(J, Z.T @ y + row * 2.01 / 0.005), rtol=1e-10)
    coloured, _ = estimate_instrumental_covariance(first, rows, solution, {})
    # white rows of unit noise: `J^-1 (Z' Z s^2 + K' K) J^-1`, with `s^2` each output's own power
    expected = np.linalg.inv(J) @ (Z.T @ Z + np.outer(row, row)) @ np.linalg.inv(J).T
    assert_allclose(coloured, expected, rtol=0.06, atol=1e-6)


def test_an_uncertain_motor_constant_adds_what_a_shift_of_it_does(rng):
    """Scale one output's force by 1 %: the answer moves by the error that 1 % of uncertainty adds."""
    first, rows, (Z, W, y) = problem(rng)
    solution = solve_instrumental_variables(first, rows)
    plain, _ = estimate_instrumental_covariance(first, rows, solution, {})
    carried, scattered = estimate_instrumental_covariance(first, rows, solution, {"j1": 0.01})
    scaled = (y.reshape(-1, 2) * [1.0, 1.01]).ravel()
    shift = np.linalg.solve(Z.T @ W, Z.T @ scaled) - solution.beta
    assert_allclose(carried - plain, np.outer(shift, shift), rtol=1e-8, atol=1e-14)
    _, without = estimate_instrumental_covariance(first, rows, solution, {})
    assert_allclose(scattered - without, np.outer(shift, shift), rtol=1e-8, atol=1e-14)
    louder, _ = estimate_instrumental_covariance(first, rows, solution, {}, factor=2.0)
    assert_allclose(louder, 4 * plain, rtol=1e-10)


def test_instruments_that_tell_nothing_apart_are_refused(rng):
    """Two instruments that are one leave one equation for two unknowns."""
    first, rows, _ = problem(rng)
    alike = [WhiteRows(x.t, x.Z[:, :, [0, 0]], x.W, x.y, None, x.keep) for x in rows]
    with raises_code("not_identifiable"):
        solve_instrumental_variables(first, alike)


def test_instruments_that_run_against_their_columns_cannot_answer(rng):
    """References of another motion tell nothing, however well conditioned `J` is: its symmetric part is no information."""
    first, rows, _ = problem(rng)
    turned = [replace(x, Z=x.Z * [1.0, -1.0]) for x in rows]
    solution = solve_instrumental_variables(first, turned)
    with raises_code("not_identifiable"):
        estimate_of(first, turned, solution)
