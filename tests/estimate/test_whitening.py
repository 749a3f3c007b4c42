"""Coloured noise made white: against the dense factor of its covariance, at the first samples of stretches and across gaps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import linalg
from scipy.signal import lfilter

from tau_dyn.estimate import Autoregression, RegressionRun, Whitener

PHI = np.array([1.2, -0.6])
RATE_HZ = 20.0


def run_of(n: int, m: int = 1, name: str = "made") -> RegressionRun:
    """Return a run that has a clock and nothing to fit."""
    none, y, all_of = np.zeros((n, m, 0)), np.zeros((n, m)), np.ones((n, m), bool)
    return RegressionRun(name, np.arange(n) / RATE_HZ, none, y, all_of, none, y)


def process(rng: np.random.Generator, n: int, phi: np.ndarray = PHI, sigma: float = 1.0) -> np.ndarray:
    """Return an autoregressive process (n,) of standard deviation `sigma`, its start died out."""
    x = lfilter([1.0], [1.0, *-phi], rng.normal(size=n + 500))[500:]
    gain = lfilter([1.0], [1.0, *-phi], np.eye(1, 2000)[0])
    return sigma * x / np.linalg.norm(gain)


def stretches(n: int, length: int, gap: int) -> np.ndarray:
    """Return a mask (n, 1) of stretches of this length with gaps between them."""
    return (np.arange(n) % (length + gap) < length)[:, None]


@pytest.mark.parametrize("gap", [1, 30])
def test_every_place_of_a_stretch_is_white_with_unit_variance(rng, gap):
    """AR(2) in stretches of 8: the first, second, ... rows have variance 1 each and no row is correlated with its neighbours.

    A row that looked over a gap, or started as if the past were zero, would have another variance.
    """
    length, n = 8, (8 + gap) * 6000
    mask = stretches(n, length, gap)
    whiten = Whitener.of([run_of(n)], [mask], [Autoregression(PHI, 4.0)])
    rows = whiten([process(rng, n, sigma=2.0)[:, None]]).reshape(-1, length)
    covariance = rows.T @ rows / len(rows)
    assert_allclose(covariance, np.eye(length), atol=4.5 * np.sqrt(2 / len(rows)))


def test_rows_are_those_of_the_dense_cholesky_factor(rng):
    """`L^-1 e` with `L L'` the Toeplitz covariance, block by block of a mask with gaps: the exact likelihood."""
    n, model = 60, Autoregression(np.array([0.5, 0.2, -0.4]), 3.0)
    mask = np.ones((n, 1), bool)
    mask[[0, 17, 18, 40, 42]] = False  # also a stretch of one sample
    e = rng.normal(size=n)
    covariance = linalg.toeplitz(model.autocovariance(n))
    expected = []
    for part in np.split(np.arange(n), np.flatnonzero(~mask[:, 0])):
        part = part[mask[part, 0]]
        if part.size:
            L = np.linalg.cholesky(covariance[np.ix_(part, part)])
            expected.append(linalg.solve_triangular(L, e[part], lower=True))
    whiten = Whitener.of([run_of(n)], [mask], [model])
    assert_allclose(whiten([e[:, None]]), np.concatenate(expected), rtol=1e-6, atol=1e-9)


def test_white_noise_is_only_scaled(rng):
    """Order zero divides by the standard deviation; samples that do not count give no row."""
    e, mask = rng.normal(size=(50, 1)), np.ones((50, 1), bool)
    mask[10:20] = False
    whiten = Whitener.of([run_of(50)], [mask], [Autoregression(np.zeros(0), 9.0)])
    assert_allclose(whiten([e]), e[mask] / 3.0)
    assert whiten.n_rows == 40


def test_a_sample_that_does_not_count_reaches_no_row(rng):
    """Spoilt samples in gaps, up to infinity's neighbourhood, change no row."""
    e, mask = rng.normal(size=(80, 1)), stretches(80, 7, 3)
    whiten = Whitener.of([run_of(80)], [mask], [Autoregression(PHI, 1.0)])
    assert_array_equal(whiten([e]), whiten([np.where(mask, e, 1e300)]))


def test_outputs_and_runs_keep_their_own_models_blocks_and_clocks(rng):
    """Rows come run by run and output by output; no 2 s block holds rows of two runs; `one` is `whiten` of that output."""
    runs = [run_of(100, 2, "one"), run_of(65, 2, "two")]
    masks = [np.ones((100, 2), bool), np.ones((65, 2), bool)]
    masks[0][30:50, 1] = False
    models = [Autoregression(np.zeros(0), 4.0), Autoregression(np.array([0.8]), 1.0)]
    whiten = Whitener.of(runs, masks, models)
    e = [rng.normal(size=(100, 2)), rng.normal(size=(65, 2))]
    rows = whiten(e)
    assert_allclose(rows[:100], e[0][:, 0] / 2)
    assert_allclose(rows[180 : 180 + 65], e[1][:, 0] / 2)
    assert_allclose(whiten.one(1, [x[:, 1] for x in e]), rows[whiten.index == 1])
    assert_array_equal(whiten.index, np.repeat([0, 1, 0, 1], [100, 80, 65, 65]))
    first, second = whiten.block[:180], whiten.block[180:]
    assert first.max() == 2 and second.min() == 3  # 5 s and 3.2 s
    assert_allclose(whiten.t[:100], runs[0].t)
    assert_array_equal(first[:100], (runs[0].t / 2.0).astype(int))


def test_columns_go_through_the_same_rows_as_residuals(rng):
    """Least squares on white rows of AR(1) is generalised least squares with the Toeplitz covariance."""
    n, model = 200, Autoregression(np.array([0.9]), 1.0)
    X, y = rng.normal(size=(n, 1, 3)), process(rng, n, np.array([0.9]))[:, None]
    whiten = Whitener.of([run_of(n)], [np.ones((n, 1), bool)], [model])
    found = np.linalg.lstsq(whiten([X]), whiten([y]), rcond=None)[0]
    inverse = np.linalg.inv(linalg.toeplitz(model.autocovariance(n)))
    expected = np.linalg.solve(X[:, 0].T @ inverse @ X[:, 0], X[:, 0].T @ inverse @ y[:, 0])
    assert_allclose(found, expected, rtol=1e-8)


def test_nothing_that_counts_is_no_row():
    """A joint that never moved has no rows, and nothing fails."""
    whiten = Whitener.of([run_of(30)], [np.zeros((30, 1), bool)], [Autoregression(PHI, 1.0)])
    assert whiten([np.ones((30, 1))]).shape == (0,)
