"""A regression's own arithmetic, on runs whose fit looks at less than there is: residuals, rows, totals, shares."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import Regression, RegressionRun, SufficientStatistics
from tau_dyn.estimate.regression import compute_triangular_factor
from tau_dyn.parameters import Parameter, Parameters

THETA = np.array([2.0, -1.0, 0.5])


def run_of(rng: np.random.Generator, n: int, name: str) -> RegressionRun:
    """Return two outputs of three columns; what the fit looks at is another signal than the whole, and half as much."""
    W, W_all = rng.normal(size=(2, n, 2, 3))
    y, y_all, force = rng.normal(size=(3, n, 2))
    return RegressionRun(name, np.arange(n) / 50, W, y, rng.random((n, 2)) > 0.5, W_all, y_all, {"force": force})


@pytest.fixture
def regression(rng) -> Regression:
    """Two runs of 40 and 25 samples."""
    parameters = Parameters(Parameter(x, 1.0, "1") for x in "abc")
    return Regression(parameters, ("j0", "j1"), ("N", "N m"), (run_of(rng, 40, "one"), run_of(rng, 25, "two")))


def test_residuals_are_measured_minus_predicted_of_what_the_fit_sees_and_of_all(regression) -> None:
    """Each run by itself, sample by sample, on paper."""
    seen, whole = regression.residuals(THETA), regression.residuals_all(THETA)
    assert [e.shape for e in seen] == [e.shape for e in whole] == [(40, 2), (25, 2)]
    for run, one, other in zip(regression.runs, seen, whole, strict=True):
        for k in range(2):
            assert_allclose(one[:, k], run.y[:, k] - run.W[:, k] @ THETA, rtol=1e-12)
            assert_allclose(other[:, k], run.y_all[:, k] - run.W_all[:, k] @ THETA, rtol=1e-12)


def test_stacked_rows_are_the_usable_ones_output_by_output_within_each_run(regression) -> None:
    """The index says whose row it is, and the sum of squares over rows is that of the usable residuals."""
    W, y, index = regression.stacked()
    one, two = regression.runs
    expected = [np.full(run.usable[:, k].sum(), k) for run in (one, two) for k in range(2)]
    assert_array_equal(index, np.concatenate(expected))
    assert_array_equal(y[: one.usable[:, 0].sum()], one.y[one.usable[:, 0], 0])
    squares = sum(np.sum(e[run.usable] ** 2) for e, run in zip(regression.residuals(THETA), (one, two), strict=True))
    assert_allclose(np.sum((y - W @ THETA) ** 2), squares)
    assert regression.n_samples == len(y) == int(one.usable.sum() + two.usable.sum())
    assert regression.used_share == pytest.approx(len(y) / (2 * 65))


def test_totals_of_runs_in_memory_are_those_of_their_rows(regression) -> None:
    """Of the rows that count, squares of `y - W theta`; of all rows, those of the unfiltered whole."""
    seen = [np.sum(np.where(r.usable, e, 0) ** 2, axis=0) for r, e in zip(regression.runs, regression.residuals(THETA),
                                                                         strict=True)]  # fmt: skip
    assert_allclose(regression.totals().squares(THETA), np.sum(seen, axis=0))
    whole = [np.sum(e**2, axis=0) for e in regression.residuals_all(THETA)]
    assert_allclose(regression.totals(whole=True).squares(THETA), np.sum(whole, axis=0))
    assert_array_equal(regression.totals(whole=True).count, [65, 65])
    rows = [piece for run in regression.rows() for piece in run]
    assert [len(piece.t) for piece in rows] == [40, 25]
    assert_array_equal(rows[1].usable, regression.runs[1].usable)


def test_a_stretch_of_a_run_has_all_its_signals(regression) -> None:
    """Time, columns, outputs, masks and what a report draws, cut alike."""
    run, part = regression.runs[0], slice(10, 16)
    cut = run.window(part)
    assert cut.name == "one" and set(cut.signals) == {"force"}
    for name in ("t", "W", "y", "usable", "W_all", "y_all"):
        assert_array_equal(getattr(cut, name), getattr(run, name)[part])
    assert_array_equal(cut.signals["force"], run.signals["force"][part])


def test_a_factor_of_many_rows_is_that_of_all_of_them(rng) -> None:
    """Rows are factored some thousands at a time; 10 000 of them, a column of zeros among theirs, leave `R' R = [W y]' [W y]`."""
    W, y = rng.normal(size=(10_000, 4)) * [1, 0, 1e3, 1e-3], rng.normal(size=10_000)
    R, whole = compute_triangular_factor(W, y), np.column_stack([W, y])
    size = np.linalg.norm(whole, axis=0)
    assert_allclose(R.T @ R, whole.T @ whole, atol=1e-11 * np.outer(size, size).max())
    assert_allclose(R / np.where(size > 0, size, 1), np.triu(R) / np.where(size > 0, size, 1), atol=1e-12)
    assert_allclose(SufficientStatistics.of(W[:, None], y[:, None]).power(), [y @ y])
