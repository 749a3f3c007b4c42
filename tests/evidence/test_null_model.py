"""What a further column would add: against brute-force regressions under the dense covariance of the noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg, stats
from scipy.optimize import nnls

from tau_dyn.effects import QuadraticDrag, Stribeck, ViscousAsymmetry
from tau_dyn.evidence.null_model import (
    MIN_UNABSORBED_SHARE,
    WhiteResidual,
    compute_robust_chance,
    compute_score_statistics,
    orthonormalise,
)


def explained(null_model, C, nonnegative=None):
    """Return T of columns (R, k) against the null_model's residual."""
    sided = np.zeros(C.shape[1], bool) if nonnegative is None else np.array(nonnegative)
    s, G = C.T @ null_model.e, null_model.gram(C)
    return float(compute_score_statistics(s[None, :, None], G[None], np.sum(C**2, axis=0)[None], sided)[0, 0])


def dense_rows(channel, part):
    """Return the factor that whitens one output's usable samples of a part by its dense Toeplitz covariance, gaps cut."""
    used = np.flatnonzero(channel.masks(part)[0][:, 0])
    covariance = linalg.toeplitz(0.8 ** np.arange(len(channel.runs[0].t)))[np.ix_(used, used)]
    block = np.cumsum(np.diff(used, prepend=used[0]) > 1)
    covariance[block[:, None] != block] = 0.0  # each stretch is its own process
    L = np.linalg.cholesky(covariance)
    return lambda x: linalg.solve_triangular(L, x[used], lower=True)


def rss(X, y):
    return float(np.sum((y - X @ np.linalg.lstsq(X, y, rcond=None)[0]) ** 2))


def test_T_is_the_drop_of_the_weighted_sum_of_squares(make, rng):
    """Frisch & Waugh: projecting the baseline out of a column first gives what refitting everything with it gives."""
    channel = make.bench(rng, lambda m: 0.5 * np.abs(m.v), n=1500)
    null_model = make.null_model(channel)
    white = dense_rows(channel, 0)
    B, y = white(channel.runs[0].W[:, 0]), white(channel.runs[0].y[:, 0])
    both = []
    for effect in (ViscousAsymmetry(("x",), ("N",)), Stribeck(("x",), ("N",), speed=0.05)):
        C = channel.columns(effect)
        both.append(C[0])
        dense = white(C[0][:, 0])
        drop = rss(B, y) - rss(np.column_stack([B, dense]), y)
        assert_allclose(explained(null_model, null_model.whiten_columns(C)), drop / null_model.scale**2, rtol=1e-6)
    C = [np.concatenate(both, axis=2)]
    drop = rss(B, y) - rss(np.column_stack([B, white(C[0][:, 0])]), y)
    assert_allclose(explained(null_model, null_model.whiten_columns(C)), drop / null_model.scale**2, rtol=1e-6)
    assert_allclose(null_model.scale**2, rss(B, y) / (len(y) - 4), rtol=1e-6)


def test_what_was_known_beforehand_counts_as_a_measurement(make, rng):
    """A mass known to 0.5 % takes part in the refit as one more row; a fixed one leaves the refit altogether."""
    plain = make.bench(rng, lambda m: 2.0 * m.a, n=1500)  # a mass 2 too large
    column = [plain.runs[0].W[:, :, :1]]
    parameters = plain.parameters
    known = parameters.update({"x_mass": {"prior_stderr": 0.1}})
    fixed = parameters.update({"x_mass": {"free": False}})
    found = []
    white = dense_rows(plain, 0)
    B, y = white(plain.runs[0].W[:, 0]), white(plain.runs[0].y[:, 0])
    for p in (parameters, known, fixed):
        channel = replace(plain, parameters=p)
        null_model = make.null_model(channel)
        found.append(explained(null_model, null_model.whiten_columns(column)) * null_model.scale**2)
    prior = np.array([[10.0, 0.0, 0.0, 0.0]])
    with_prior = rss(np.concatenate([B, prior]), np.append(y, 200.0))
    assert found[0] == 0.0  # the refit takes it all
    assert_allclose(found[1], with_prior - rss(B, y), rtol=1e-6)
    assert_allclose(found[2], rss(B[:, 1:], y - 20 * B[:, 0]) - rss(B, y), rtol=1e-6)


def test_amplitudes_from_zero_up_are_the_nonnegative_least_squares(rng):
    """T is what `scipy.optimize.nnls` explains, for one, two and three bounded columns and beside a free one."""
    for nonnegative in ([True], [True, True], [True] * 3, [True, False, True]):
        k = len(nonnegative)
        for _ in range(40):
            C, e = rng.normal(size=(30, k)) + 0.5 * rng.normal(size=(30, 1)), rng.normal(size=30)
            X = np.column_stack([C, -C[:, ~np.array(nonnegative)]])  # a free column is two bounded ones
            expected = e @ e - nnls(X, e)[1] ** 2
            T = compute_score_statistics(
                (C.T @ e)[None, :, None], (C.T @ C)[None], np.sum(C**2, axis=0)[None], np.array(nonnegative)
            )
            assert_allclose(T[0, 0], expected, rtol=1e-8, atol=1e-9)


def test_a_negative_drag_explains_nothing(make, rng):
    """A force of the wrong sign for a cause leaves its T at zero; of the right sign T is that of the free column."""
    for sign in (-1.0, 1.0):
        channel = make.bench(rng, lambda m, s=sign: s * 150 * m.v * np.abs(m.v))
        null_model = make.null_model(channel)
        C = null_model.whiten_columns(channel.columns(QuadraticDrag(("x",), ("N",))))
        free, bounded = explained(null_model, C), explained(null_model, C, [True])
        assert free > 50
        assert_allclose(bounded, free if sign > 0 else 0.0)


def test_a_column_that_the_baseline_absorbs_explains_exactly_nothing(make, rng):
    """A copy of a baseline column, or one that differs from it by less than the tolerance, gets T = 0 and not 0 / 0."""
    channel = make.bench(rng)
    null_model = make.null_model(channel)
    column = null_model.whiten_columns([channel.runs[0].W[:, :, 1:2]])
    assert explained(null_model, 1e6 * column) == 0.0
    other = null_model.project_out(rng.normal(size=column.shape))
    other *= np.linalg.norm(column) / np.linalg.norm(other)
    assert explained(null_model, column + 0.5 * np.sqrt(MIN_UNABSORBED_SHARE) * other) == 0.0
    beyond = explained(null_model, column + 2 * np.sqrt(MIN_UNABSORBED_SHARE) * other)
    assert_allclose(beyond, explained(null_model, other), rtol=1e-4)
    assert explained(null_model, np.zeros_like(column)) == 0.0


def test_of_two_columns_the_one_not_absorbed_still_counts(make, rng):
    """An absorbed companion takes nothing away from a column that shows something."""
    channel = make.bench(rng, lambda m: 2 * np.abs(m.v))
    null_model = make.null_model(channel)
    C = null_model.whiten_columns(channel.columns(ViscousAsymmetry(("x",), ("N",))))
    absorbed = null_model.whiten_columns([channel.runs[0].W[:, :, :1]])
    assert_allclose(explained(null_model, np.column_stack([C, absorbed])), explained(null_model, C), rtol=1e-3)


def test_a_column_of_rounding_is_no_column() -> None:
    """In samples where a column is zero but for rounding, which may make its square negative, the other one counts alone."""
    C = np.random.default_rng(0).normal(size=(50, 2))
    G = np.stack([C.T @ C, np.diag([1e-17, 30.0])])
    raw = np.stack([np.diag(C.T @ C), [-1e-18, 30.0]])
    T = compute_score_statistics(np.ones((2, 2, 1)), G, raw, np.zeros(2, bool), 1e-3)
    assert T[1, 0] == pytest.approx(1 / 30)


@pytest.mark.parametrize("dof", [1, 3])
def test_T_of_pure_noise_is_chi_square(make, rng, dof):
    """Coloured noise, gaps and an estimated scale: T of slow columns follows chi-square with as many degrees of freedom."""
    channel = make.bench(rng, n=1500)
    motion, W = channel.motions[0], channel.runs[0].W
    C = np.column_stack([np.abs(motion.v[:, 0]), np.sign(motion.q[:, 0]), motion.q[:, 0] ** 2])[:, None, :dof]
    found = []
    for _ in range(250):
        y = W @ channel.parameters.values + make.coloured(rng, 1500, 1)
        again = make.null_model(make.measuring(channel, y))
        found.append(explained(again, again.whiten_columns([C])))
    assert stats.kstest(found, stats.chi2(dof).cdf).pvalue > 0.01


def test_draws_are_noise_as_the_baseline_leaves_it(make, rng):
    """Draws are orthogonal to everything accounted for, and their T is chi-square as that of a clean log."""
    channel = make.bench(rng, n=2000)
    beside = ViscousAsymmetry(("x",), ("N",))
    null_model = make.null_model(channel, beside=[beside])
    draws = null_model.draw_null_residuals(400, rng)
    assert_allclose(null_model.Q.T @ draws, 0.0, atol=1e-9)
    assert_allclose(null_model.rows(beside).T @ draws, 0.0, atol=1e-6)
    C = null_model.whiten_columns(channel.columns(QuadraticDrag(("x",), ("N",))))
    T = (C.T @ draws)[0] ** 2 / null_model.gram(C)[0, 0]
    assert stats.kstest(T, stats.chi2(1).cdf).pvalue > 0.01


def test_the_noncentrality_of_the_true_column_is_lambda(make, rng):
    """E[T] = 1 + lambda, lambda the squared norm of the whitened misfit after refitting the baseline."""
    size, found = 8.0, []
    plain = make.bench(rng, n=1500, noise=0.0)
    column = plain.columns(ViscousAsymmetry(("x",), ("N",)))
    white = dense_rows(plain, 0)
    strength = rss(white(plain.runs[0].W[:, 0]), size * white(column[0][:, 0])[:, 0])
    for _ in range(200):
        y = plain.runs[0].y + size * column[0][:, :, 0] + make.coloured(rng, 1500, 1)
        null_model = make.null_model(make.measuring(plain, y))
        found.append(explained(null_model, null_model.whiten_columns(column)) * null_model.scale**2)
    assert strength > 10
    assert_allclose(np.mean(found), 1 + strength, atol=4 * np.sqrt((2 + 4 * strength) / 200))
    assert stats.kstest(found, stats.ncx2(1, strength).cdf).pvalue > 0.01


def test_an_orthonormal_basis_leaves_dependent_columns_out(rng):
    """Of a, b, a + b and zero two directions are left, whatever their units."""
    a, b = rng.normal(size=(2, 50))
    Q = orthonormalise(np.column_stack([1e6 * a, 1e-6 * b, a + b, np.zeros(50)]))
    assert Q.shape == (50, 2)
    assert_allclose(Q.T @ Q, np.eye(2), atol=1e-12)
    assert_allclose(Q @ (Q.T @ (a - 3 * b)), a - 3 * b, atol=1e-9)


def stand_in(rng, scatter, rows=40, signal=0.0):
    """Return white rows in blocks whose noise has these standard deviations, and functions of a motion that grows in time."""
    n = len(scatter) * rows
    block, t = np.repeat(np.arange(len(scatter)), rows), np.linspace(0, 1, n)
    C = np.polynomial.legendre.legvander(t**2 * np.sin(110 * t + rng.uniform(0, 6)), 6)[:, 1:]
    Q = orthonormalise(rng.standard_normal((n, 3)))
    e = signal * C[:, 1] + scatter[block] * rng.standard_normal(n)
    whiten = SimpleNamespace(block=block)
    return WhiteResidual(None, (0,), whiten, Q, e - Q @ (Q.T @ e), (), 1.0), C


def test_blocks_with_more_noise_do_not_make_a_statistic_significant(rng):
    """Noise grows with the motion: at 1 % the noise model rejects more than 5 % of clean residuals, the blocks 1 to 3 %."""
    scatter = np.linspace(0.2, 1.8, 20)
    by_model, by_blocks = [], []
    for _ in range(400):
        null_model, C = stand_in(rng, scatter)
        by_model.append(stats.chi2.sf(explained(null_model, C), C.shape[1]))
        by_blocks.append(compute_robust_chance(null_model, C))
    assert np.mean(np.array(by_model) < 0.01) > 0.05
    assert np.mean(np.array(by_blocks) < 0.01) < 0.03


def test_white_noise_has_the_same_significance_by_blocks(rng):
    """Of 400 clean residuals 1 to 8 % are below 5 %; a force as large as the noise is seen in each of 20 logs of 80 s."""
    clean = [compute_robust_chance(*stand_in(rng, np.ones(20))) for _ in range(400)]
    assert 0.01 < np.mean(np.array(clean) < 0.05) < 0.08
    assert max(compute_robust_chance(*stand_in(rng, np.ones(40), signal=1.0)) for _ in range(20)) < 1e-3


def test_functions_that_one_block_alone_shows_stay_testable(rng):
    """A single block has no scatter around its fit; the p-value is still one, and none of the rows is infinite."""
    null_model, C = stand_in(rng, np.ones(1))
    assert 0 <= compute_robust_chance(null_model, C) <= 1
