"""Weighted least squares: weights, fixed parameters, prior knowledge, uncertain motor constants."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.estimate import Regression, RegressionRun, solve_least_squares
from tau_dyn.parameters import Parameter, Parameters

TRUTH = np.array([3.0, -1.0, 0.5])
NOISE = np.array([0.1, 2.0])


def make(rng: np.random.Generator, n: int = 3000, noise: np.ndarray = NOISE) -> Regression:
    """Return two outputs of three parameters, the second twenty times as noisy."""
    W = rng.normal(size=(n, 2, 3))
    y = W @ TRUTH + noise * rng.normal(size=(n, 2))
    run = RegressionRun("made", np.arange(n) / 50, W, y, np.ones((n, 2), bool), W, y)
    return Regression(Parameters(Parameter(x, 1.0, "1") for x in "abc"), ("j0", "j1"), ("N", "N"), (run,))


def white_cov(regression: Regression, columns: list[int], noise: np.ndarray = NOISE) -> np.ndarray:
    W = np.concatenate([regression.runs[0].W[:, k][:, columns] / noise[k] for k in range(2)])
    return np.linalg.inv(W.T @ W)


def test_each_output_is_weighted_by_its_own_noise(rng):
    """The noise of each joint is found to 5 %, and the errors are those of weighted least squares, far below plain ones."""
    regression = make(rng)
    e = solve_least_squares(regression)
    assert_allclose(e.sigma, NOISE, rtol=0.05)
    best = np.sqrt(np.diag(white_cov(regression, [0, 1, 2])))
    assert np.all(e.stderr < 1.4 * best)  # the larger of two noisy errors
    assert np.all(np.abs(e.beta - TRUTH) < 4 * best)
    assert np.all(e.stderr > 0.9 * best)


def test_the_noise_of_few_samples_is_not_made_small_by_the_fit(rng):
    """Three parameters of both joints' 24 rows: the variance is 1 in the mean of 400 fits, which leave 21 of 24 of it."""
    found = [solve_least_squares(make(rng, 12, np.ones(2))).sigma ** 2 for _ in range(400)]
    assert_allclose(np.mean(found), 1.0, atol=0.05)


def test_without_noise_the_truth_comes_back(rng):
    """1e-9 is what rounding leaves of 3000 exact equations."""
    e = solve_least_squares(make(rng, noise=np.zeros(2)))
    assert_allclose(e.theta, TRUTH, atol=1e-9)
    assert np.all(np.isfinite(e.stderr))


def test_the_condition_number_is_that_of_unit_columns(rng):
    """Two columns with a cosine of 0.8 between them, at sizes a thousand apart: `sqrt((1 + 0.8) / (1 - 0.8)) = 3`."""
    a, b = np.linalg.qr(rng.normal(size=(400, 2)))[0].T
    W = np.stack([a, 1e3 * (0.8 * a + 0.6 * b)], axis=1)[:, None]
    y = W @ [1.0, 1e-3] + 1e-3 * rng.normal(size=(400, 1))
    run = RegressionRun("made", np.arange(400) / 50, W, y, np.ones((400, 1), bool), W, y)
    e = solve_least_squares(Regression(Parameters(Parameter(x, 1.0, "1") for x in "ab"), ("j0",), ("N",), (run,)))
    assert_allclose(e.cond, 3.0, rtol=1e-9)
    assert_allclose(e.residuals()[0][:, 0], y[:, 0] - W[:, 0] @ e.theta, rtol=1e-9)
    assert_allclose(e.correlation, [[1, -0.8], [-0.8, 1]], atol=0.05)  # white noise, but for what its model makes of it


def test_a_fixed_parameter_is_subtracted_and_leaves_the_solver(rng):
    """Fixed at its true value it changes nothing but certainty; fixed at a wrong one it stays and the residual grows."""
    regression = make(rng)
    right = regression.parameters.update({"b": {"value": -1.0, "free": False}})
    e = solve_least_squares(regression.with_parameters(right))
    assert e.base.names == ("a", "c")
    assert e.parameters["b"].value == -1.0
    assert e.parameters["b"].stderr is None
    assert np.all(np.abs(e.beta - TRUTH[[0, 2]]) < 4 * np.sqrt(np.diag(white_cov(regression, [0, 2]))))
    wrong = solve_least_squares(regression.with_parameters(right.with_values({"b": 0.0})))
    assert wrong.sigma[0] > 5 * e.sigma[0]


def test_prior_knowledge_enters_as_bayes_has_it(rng):
    """Value and error of a measured parameter follow `P = C^-1 + 1/s^2`, `theta = P^-1 (C^-1 theta_LS + prior / s^2)`."""
    regression = make(rng, n=400)
    s, prior = 0.006, 3.02
    known = regression.parameters.update({"a": {"value": prior, "prior_stderr": s}})
    e = solve_least_squares(regression.with_parameters(known))
    information = np.linalg.inv(white_cov(regression, [0, 1, 2], e.sigma))
    run, gain = regression.runs[0], np.diag([1 / s**2, 0, 0])
    seen = np.einsum("nmp,nm->p", run.W / e.sigma[:, None] ** 2, run.y)  # C^-1 theta_LS
    assert_allclose(e.beta, np.linalg.solve(information + gain, seen + gain @ [prior, 0, 0]), rtol=1e-7)
    posterior = np.sqrt(np.linalg.inv(information + gain)[0, 0])
    assert posterior < 0.8 * s
    assert 0.9 * posterior < e.parameters["a"].stderr < 1.3 * posterior


def test_an_exact_prior_beats_the_data_and_a_vague_one_does_not(rng):
    """With a tiny error the prior is the answer and its error; with a huge one nothing changes."""
    regression = make(rng)
    plain = solve_least_squares(regression)
    for sigma, value, stderr in ((1e-7, 2.5, 1e-7), (1e4, plain.parameters["a"].value, plain.parameters["a"].stderr)):
        known = regression.parameters.update({"a": {"value": 2.5, "prior_stderr": sigma}})
        e = solve_least_squares(regression.with_parameters(known))
        assert_allclose(e.parameters["a"].value, value, rtol=1e-4)
        assert_allclose(e.parameters["a"].stderr, stderr, rtol=1e-3)


def test_an_uncertain_motor_constant_is_carried_through(rng):
    """The error it adds is `d beta / d gain` times the gain's: scale that output by 1 % and look how the answer shifts."""
    regression = make(rng, noise=np.array([0.05, 0.05]))
    sigma = 0.01
    plain, carried = solve_least_squares(regression), solve_least_squares(regression, gains={"j0": sigma})
    run = regression.runs[0]
    scaled = replace(run, y=run.y * [1 + 1e-4, 1.0])
    shift = np.array(solve_least_squares(replace(regression, runs=(scaled,))).beta - plain.beta) / 1e-4
    assert_allclose(carried.beta, plain.beta, rtol=1e-12)
    added = np.diag(carried.cov) - np.diag(plain.cov)
    assert_allclose(added, (sigma * shift) ** 2, rtol=2e-2, atol=1e-9)  # the weights move a little with the scale
    assert np.all(carried.stderr >= plain.stderr)


def test_one_gain_for_all_outputs_scales_all_parameters(rng):
    """Both motor constants unsure by 2 %, independently: each parameter is at least 1.4 % unsure."""
    e = solve_least_squares(make(rng, noise=np.array([0.01, 0.01])), gains={"j0": 0.02, "j1": 0.02})
    assert_allclose(e.stderr / np.abs(TRUTH), 0.02 / np.sqrt(2), rtol=0.2)


def test_runs_are_judged_together_and_masks_are_obeyed(rng):
    """Spoilt samples that a mask leaves out change nothing; two halves as two runs are the same as one run."""
    regression = make(rng)
    run = regression.runs[0]
    spoilt, usable = run.y.copy(), run.usable.copy()
    spoilt[100:300, 0], usable[100:300, 0] = 1e6, False
    one = replace(regression, runs=(replace(run, y=spoilt, usable=usable),))
    two = replace(
        regression,
        runs=tuple(replace(run, y=spoilt, usable=usable).window(s) for s in (slice(0, 1500), slice(1500, 3000))),
    )
    a, b = solve_least_squares(one), solve_least_squares(two)
    assert_allclose(a.beta, b.beta, rtol=1e-9)
    assert_allclose(a.stderr, b.stderr, rtol=0.1)
    assert np.all(np.abs(a.beta - TRUTH) < 4 * a.stderr)
    assert a.regression.n_samples == 5800


def test_a_standard_error_stands_only_where_a_parameter_is_seen_alone(rng):
    """Where a and b act as their sum, neither has an error of its own."""
    regression = make(rng)
    run = regression.runs[0]
    W = run.W.copy()
    W[..., 1] = W[..., 0]
    e = solve_least_squares(replace(regression, runs=(replace(run, W=W, y=W @ TRUTH + rng.normal(size=run.y.shape)),)))
    assert [p.stderr is None for p in e.parameters] == [True, True, False]
    assert e.base.expression(0) == "a + b"
    assert abs(e.beta[0] - 2.0) < 4 * e.stderr[0]


def test_too_few_samples_cannot_answer(rng):
    """Three unknowns need more than three numbers."""
    regression = make(rng, n=20)
    mask = np.zeros((20, 2), bool)
    mask[:3, 0] = True
    with raises_code("too_little_data", "3"):
        solve_least_squares(replace(regression, runs=(replace(regression.runs[0], usable=mask),)))
