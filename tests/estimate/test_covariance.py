"""How certain least squares is under coloured noise: against the theory of autoregressions and against repetition."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg
from scipy.signal import lfilter

from tau_dyn.estimate import Autoregression, Regression, RegressionRun, fit_autoregression, solve_least_squares
from tau_dyn.parameters import Parameter, Parameters

RATE_HZ = 20.0


def coloured(rng: np.random.Generator, n: int, phi: tuple[float, ...], m: int = 1) -> np.ndarray:
    """Return an autoregressive process (n, m) driven by unit noise, after its start has died out."""
    return lfilter([1.0], [1.0, *(-x for x in phi)], rng.normal(size=(n + 500, m)), axis=0)[500:]


def problem(rng: np.random.Generator, noise: np.ndarray, usable: np.ndarray, columns: np.ndarray) -> Regression:
    """Return a regression with true parameters 1, -2 and this noise (n, m)."""
    y = columns @ [1.0, -2.0] + noise
    run = RegressionRun("made", np.arange(len(y)) / RATE_HZ, columns, y, usable, columns, y)
    outputs = tuple(f"j{k}" for k in range(y.shape[1]))
    return Regression(
        Parameters([Parameter("a", 0.0, "1"), Parameter("b", 0.0, "1")]), outputs, ("N",) * len(outputs), (run,)
    )


def slow_columns(rng: np.random.Generator, n: int, m: int) -> np.ndarray:
    """Return columns as slow as motion: colour matters to them, (n, m, 2)."""
    return np.stack([coloured(rng, n, (0.95,), m), np.sign(coloured(rng, n, (0.9,), m))], axis=2)


def test_an_autoregression_is_recovered(rng):
    """AR(2) coefficients within 4 standard errors (about 1 / sqrt(n)), in unbroken stretches of 50 to 3000 samples."""
    phi, x = np.array([1.2, -0.6]), coloured(rng, 12000, (1.2, -0.6))[:, 0]
    cuts = np.cumsum([3000, 50, 2000, 700, 3000])
    model = fit_autoregression(np.split(x, cuts), max_order=2)
    assert_allclose(model.phi, phi, atol=4 / np.sqrt(len(x)))
    assert_allclose(model.variance, np.var(x), rtol=1e-2)


def test_white_noise_is_taken_for_white(rng):
    """Akaike's criterion keeps at most a coefficient or two of chance, none of them large."""
    model = fit_autoregression([rng.normal(size=5000)])
    assert np.all(np.abs(model.phi) < 4 / np.sqrt(5000))


def test_an_order_costs_what_chance_gains_by_it(rng):
    """Of 60 long white residuals Akaike's criterion leaves 71 % without a coefficient, in theory; unpunished, none would be."""
    orders = [len(fit_autoregression([rng.normal(size=4000)]).phi) for _ in range(60)]
    assert 0.71 - 3 * np.sqrt(0.71 * 0.29 / 60) < np.mean(np.array(orders) == 0) < 0.71 + 3 * np.sqrt(0.71 * 0.29 / 60)


def test_autocovariance_is_that_of_theory():
    """For AR(1) it is `variance phi^k`; for AR(2) it obeys Yule and Walker's recursion."""
    assert_allclose(Autoregression(np.array([0.9]), 4.0).autocovariance(50), 4 * 0.9 ** np.arange(50), rtol=1e-9)
    c = Autoregression(np.array([1.2, -0.6]), 1.0).autocovariance(30)
    assert_allclose(c[2:], 1.2 * c[1:-1] - 0.6 * c[:-2], atol=1e-12)
    assert_allclose(c[1], 1.2 / 1.6, rtol=1e-9)
    assert_allclose(Autoregression(np.zeros(0), 2.0).autocovariance(3), [2, 0, 0])


def test_an_explosive_fit_is_pulled_back(rng):
    """A drifting residual has no finite covariance; the model answers with a large one instead of infinity."""
    model = fit_autoregression([np.exp(0.01 * np.arange(600)) * (1 + 0.01 * rng.normal(size=600))])
    assert np.all(np.isfinite(model.autocovariance(600)))
    assert np.max(np.abs(np.roots([1.0, *-model.phi]))) < 0.9991


def test_one_pole_outside_the_circle_is_pulled_back():
    """`1.01^k` is an autoregression of order one with its pole at 1.01; none is believed beyond 0.999."""
    assert fit_autoregression([1.01 ** np.arange(600)], max_order=1).phi == pytest.approx([0.999])


@pytest.mark.parametrize("phi", [(), (0.97,), (1.2, -0.6)], ids=["white", "ar1", "ar2"])
def test_the_covariance_is_the_dense_one_of_its_noise_model(rng, phi):
    """`(W'W)^-1 W' C W (W'W)^-1` with the Toeplitz matrix of the model found, to the run's last sample and across a gap."""
    n, columns = 300, slow_columns(rng, 300, 1)
    usable = np.ones((n, 1), bool)
    usable[100:130] = False
    e = solve_least_squares(problem(rng, coloured(rng, n, phi), usable, columns))
    Z = np.where(usable, columns[:, 0] / e.sigma, 0.0)
    C = linalg.toeplitz(e.noise[0].autocovariance(n))
    inverse = np.linalg.inv(Z.T @ Z)
    free = usable.sum() / (usable.sum() - 2)
    assert_allclose(e.cov, free * inverse @ Z.T @ C @ Z @ inverse, rtol=1e-6)


@pytest.mark.parametrize(
    ("phi", "gaps"),
    [((), False), ((0.9,), False), ((0.9,), True), ((1.2, -0.6), True)],
    ids=["white", "ar1", "gaps", "ar2"],
)
def test_standard_errors_are_those_of_repetition(rng, phi, gaps):
    """Over 150 repetitions the stated standard error is the scatter of the estimates, never below it, little above.

    The scatter of 150 estimates is known to 6 %; stating the larger of two noisy errors adds some 5 to 15 %.
    """
    n, columns = 1200, slow_columns(rng, 1200, 2)
    usable = np.ones((n, 2), bool)
    if gaps:  # two thirds of the samples, in pieces of 5 to 40 as reversals leave them, each output its own
        for k in range(2):
            for start in rng.integers(0, n, 60):
                usable[start : start + rng.integers(5, 40), k] = False
    found = [solve_least_squares(problem(rng, coloured(rng, n, phi, 2), usable, columns)) for _ in range(150)]
    scatter = np.std([e.beta for e in found], axis=0)
    stated = np.mean([e.stderr for e in found], axis=0)
    assert_allclose(np.mean([e.beta for e in found], axis=0), [1, -2], atol=0.3 * scatter.max())
    assert np.all(stated / scatter > 0.85)
    assert np.all(stated / scatter < 1.35)
    z = (np.array([e.beta for e in found]) - [1, -2]) / [e.stderr for e in found]
    assert (
        0.92 < np.mean(np.abs(z) < 1.96) < 0.995
    )  # 300 intervals: 0.95 less 2.5 sd of 1.3 %, and conservative by design


def test_ignoring_colour_would_understate(rng):
    """Under AR(1) 0.9 the errors of slow columns are more than twice those that white noise of that size would leave."""
    columns, usable = slow_columns(rng, 2000, 1), np.ones((2000, 1), bool)
    e = solve_least_squares(problem(rng, coloured(rng, 2000, (0.9,)), usable, columns))
    W = columns[:, 0] / e.sigma
    assert np.all(e.stderr > 2 * np.sqrt(np.diag(np.linalg.inv(W.T @ W))))


def test_blocks_see_noise_that_no_autoregression_has(rng):
    """Noise that grows with its own column (a friction not in the model) raises that column's error above the AR one."""
    n = 4000
    slow = np.repeat(rng.normal(size=(n // 40, 1)), 40, axis=0)  # 2 s, one block
    columns = np.stack([np.abs(coloured(rng, n, (0.5,))) * (1 + np.abs(slow)), rng.normal(size=(n, 1))], axis=2)
    e = solve_least_squares(
        problem(rng, slow * columns[..., 0] + rng.normal(size=(n, 1)), np.ones((n, 1), bool), columns)
    )
    assert e.scatter[0, 0] > 2 * e.cov[0, 0]
    assert_allclose(e.stderr[0] ** 2, e.scatter[0, 0])


def test_blocks_that_no_output_uses_do_not_count(rng):
    """B blocks scatter by their scores' squares times `B / (B - 1)`; a block of unused samples is none of them."""
    n, per = 240, 40  # 20 Hz: 2 s a block
    columns = np.stack([np.ones((n, 1)), np.tile([[1.0], [-1.0]], (n // 2, 1))], axis=2)
    usable = np.ones((n, 1), bool)
    usable[per : 2 * per] = False
    e = solve_least_squares(problem(rng, rng.normal(size=(n, 1)), usable, columns))
    used, left = usable.sum(), np.where(usable, e.residuals()[0], 0.0)
    scores = (left * columns[:, 0]).reshape(n // per, per, 2).sum(axis=1)  # columns are orthogonal: `used` times unity
    assert_allclose(e.scatter, scores.T @ scores * 5 / 4 / used**2, rtol=1e-9)


def test_a_sum_is_as_certain_as_the_data_make_it(rng):
    """Two columns that are nearly the same: each coefficient is vague, their sum is not, by whatever covariance.

    Inflating one parameter by parameter would make the sum vague as well.
    """
    n = 3000
    a = coloured(rng, n, (0.9,))
    columns = np.stack([a, a + 0.01 * rng.normal(size=(n, 1)) * (1 + 3 * (np.arange(n)[:, None] % 400 < 40))], axis=2)
    sums = []
    for _ in range(60):
        e = solve_least_squares(problem(rng, coloured(rng, n, (0.8,)), np.ones((n, 1), bool), columns))
        sums.append((e.beta_plain.sum() + 1, e.stderr_of(np.ones(2)), e.stderr[0]))
    error, stated, single = np.array(sums).T
    assert np.mean(stated) < 1.5 * np.std(error)
    assert np.mean(single) > 20 * np.mean(stated)


def test_a_combination_has_the_larger_of_its_two_errors(rng):
    """Where blocks scatter twice as much as the noise model says, any sum of parameters is half as certain."""
    n = 400
    e = solve_least_squares(problem(rng, rng.normal(size=(n, 1)), np.ones((n, 1), bool), slow_columns(rng, n, 1)))
    w = np.array([0.3, -2.0])
    for factor, larger in ((4.0, 4.0), (0.25, 1.0)):
        both = replace(e, scatter=factor * e.cov)
        assert_allclose(both.stderr_of(w) ** 2, larger * (w @ e.cov @ w))
        assert_allclose(both.stderr**2, larger * np.diag(e.cov))
