"""Sums of parameters that the data tell, though they tell none of the terms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.estimate import Regression, RegressionRun, combine_parameters, solve_least_squares
from tau_dyn.parameters import Parameter, Parameters

TRUTH = np.array([2.0, 3.0, 0.5, 7.0])


@pytest.fixture
def estimate():
    """Return an estimate of `m1`, `m2`, `c`, of which only `m1 + 0.25 m2` and `c` are seen; `known` is fixed at 7."""
    rng = np.random.default_rng(3)
    n = 4000
    a, v, g = rng.normal(size=(3, n))
    W = np.stack([a, 0.25 * a, v, g], axis=1)[:, None, :]
    y = W @ TRUTH + 0.1 * rng.normal(size=(n, 1))
    names = ("m1", "m2", "c", "known")
    parameters = Parameters(
        Parameter(name, x, "kg", free=name != "known") for name, x in zip(names, TRUTH, strict=True)
    )
    start = parameters.with_values({"m1": 1.0, "m2": 1.0, "c": 0.0})
    run = RegressionRun("made", np.arange(n) / 100, W, y, np.ones((n, 1), bool), W, y)
    return solve_least_squares(Regression(start, ("axis",), ("N",), (run,)))


def test_a_seen_sum_of_unseen_terms_has_value_and_error(estimate):
    """`m1 + 0.25 m2 = 2.75` with the standard error of a mean of white noise, 0.1 / sqrt(4000)."""
    value, stderr = combine_parameters(estimate, {"m1": 1.0, "m2": 0.25})
    assert abs(value - 2.75) < 4 * stderr
    assert_allclose(stderr, 0.1 / np.sqrt(4000), rtol=0.05)  # the noise model is estimated


def test_a_sum_of_two_seen_numbers_uses_their_covariance(estimate):
    """Twice the first minus the second has variance `4 s1^2 + s2^2 - 4 s12`."""
    value, stderr = combine_parameters(estimate, {"m1": 2.0, "m2": 0.5, "c": -1.0})
    w = np.array([2.0, -1.0])
    assert_allclose(stderr, np.sqrt(w @ estimate.cov @ w), rtol=1e-9)
    assert_allclose(value, w @ estimate.beta_plain, rtol=1e-9)


def test_a_fixed_parameter_counts_as_exact(estimate):
    """Adding what is fixed moves the value, not its error."""
    alone, both = combine_parameters(estimate, {"c": 1.0}), combine_parameters(estimate, {"c": 1.0, "known": 2.0})
    assert_allclose(both.value - alone.value, 14.0, rtol=1e-9)
    assert both.stderr == alone.stderr


def test_what_the_data_do_not_tell_is_refused(estimate):
    """`m1` alone, or the two masses in other proportions, is not in the data."""
    for weights in ({"m1": 1.0}, {"m1": 1.0, "m2": 0.3}, {"m2": 1.0}):
        with raises_code("not_identifiable"):
            combine_parameters(estimate, weights)


def test_an_unknown_name_is_refused(estimate):
    """A misspelt parameter must not count as zero."""
    with raises_code("unknown_name", "m3"):
        combine_parameters(estimate, {"m3": 1.0})
