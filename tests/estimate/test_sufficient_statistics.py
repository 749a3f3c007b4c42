"""Totals say of rows what the rows themselves say: sums, squares, scaled, added, with and without a mask."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.estimate import (
    Regression,
    RegressionRows,
    RegressionRun,
    StreamedData,
    SufficientStatistics,
    solve_least_squares,
)
from tau_dyn.parameters import Parameter, Parameters

N, M, P = 50, 2, 3


@pytest.fixture
def rows(rng):
    """Return columns (N, M, P), one of zeros, measurements (N, M), and which count."""
    W, y, usable = rng.normal(size=(N, M, P)), rng.normal(size=(N, M)), rng.random((N, M)) > 0.3
    W[:, 1, 2] = 0.0
    return W, y, usable


def same(totals: SufficientStatistics, W: np.ndarray, y: np.ndarray, usable: np.ndarray, theta: np.ndarray) -> None:
    """Compare every answer with sums over the rows."""
    e = np.where(usable, y - W @ theta, 0.0)
    assert_allclose(totals.squares(theta), np.sum(e**2, axis=0), rtol=1e-12)
    assert_allclose(totals.power(), np.sum(np.where(usable, y, 0.0) ** 2, axis=0), rtol=1e-12)
    assert_allclose(totals.count, usable.sum(axis=0))
    whole = np.concatenate([W, y[:, :, None]], axis=2)
    assert_allclose(totals.sums, np.einsum("nmp,nm->mp", whole, usable.astype(float)), rtol=1e-12, atol=1e-12)
    gram = np.einsum("nmp,nm,nmq->mpq", whole, usable.astype(float), whole)
    assert_allclose(np.swapaxes(totals.R, 1, 2) @ totals.R, gram, rtol=1e-10, atol=1e-12)


def test_totals_are_those_of_the_rows_that_count(rows, rng):
    """Gram matrix, sums, squared residuals and power of each output, for any parameters; no rows have none."""
    W, y, usable = rows
    theta = rng.normal(size=P)
    same(SufficientStatistics.of(W, y, usable), W, y, usable, theta)
    same(SufficientStatistics.of(W, y), W, y, np.ones_like(usable), theta)
    same(SufficientStatistics.of(W, y) + SufficientStatistics.zero(M, P), W, y, np.ones_like(usable), theta)


def test_totals_add_as_rows_follow_each_other(rows, rng):
    """Two parts together are the whole, wherever it is cut, also where a part is shorter than the parameters are many."""
    W, y, usable = rows
    for cut in (2, 20):
        parts = (slice(0, cut), slice(cut, N))
        one, two = (SufficientStatistics.of(W[part], y[part], usable[part]) for part in parts)
        same(one + two, W, y, usable, rng.normal(size=P))


def test_a_factor_scales_measurements_and_not_columns(rows, rng):
    """As if the log had been multiplied: another motor constant for each joint."""
    W, y, usable = rows
    factors = np.array([1.1, -0.5])
    same(SufficientStatistics.of(W, y, usable).scaled(factors), W, y * factors, usable, rng.normal(size=P))


def test_a_regression_of_more_than_memory_holds_counts_all_of_it(rows, rng):
    """Samples, used share and totals are of all data, not of the excerpts kept; without data nothing is used."""
    W, y, usable = rows
    parameters = Parameters(Parameter(x, 0.0, "1") for x in "abc")
    t = np.arange(N) / 10.0
    pieces = [
        [RegressionRows(t[:20], W[:20], y[:20], usable[:20]), RegressionRows(t[20:], W[20:], y[20:], usable[20:])]
    ]
    all_ = StreamedData(SufficientStatistics.of(W, y, usable), SufficientStatistics.of(W, y), pieces)
    large = Regression(parameters, ("j0", "j1"), ("N", "N"), (), everything=all_)
    assert large.n_samples == usable.sum() and large.used_share == pytest.approx(usable.mean())
    theta = rng.normal(size=P)
    same(large.totals(), W, y, usable, theta)
    same(large.totals(whole=True), W, y, np.ones_like(usable), theta)
    assert [len(piece.t) for run in large.rows() for piece in run] == [20, 30]
    assert Regression(parameters, ("j0", "j1"), ("N", "N"), ()).used_share == 0.0


def test_errors_do_not_depend_on_how_a_recording_is_cut(rng):
    """Coloured noise with gaps, whole and in pieces of 37: the same noise model and covariance, no stretch joined or lost."""
    n = 600
    noise = np.zeros(n)
    for k in range(1, n):
        noise[k] = 0.8 * noise[k - 1] + rng.normal()
    W, t = np.cumsum(rng.normal(size=(n, 1, 2)), axis=0), np.arange(n) / 10.0
    y, usable = W @ [1.0, -2.0] + noise[:, None], (np.arange(n) % 50 > 6)[:, None]
    parameters = Parameters(Parameter(x, 0.0, "1") for x in "ab")
    whole = Regression(parameters, ("j0",), ("N",), (RegressionRun("made", t, W, y, usable, W, y),))
    pieces = [RegressionRows(*(x[k : k + 37] for x in (t, W, y, usable))) for k in range(0, n, 37)]
    all_ = StreamedData(SufficientStatistics.of(W, y, usable), SufficientStatistics.of(W, y), [pieces])
    one, other = (solve_least_squares(r) for r in (whole, Regression(parameters, ("j0",), ("N",), (), everything=all_)))
    assert_allclose(other.beta, one.beta, rtol=1e-9)
    assert_allclose(other.noise[0].phi, one.noise[0].phi, rtol=1e-6, atol=1e-9)
    assert_allclose([other.cov, other.scatter], [one.cov, one.scatter], rtol=1e-6)
