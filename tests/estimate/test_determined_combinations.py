"""Sums that a motion tells although it hardly tells their terms."""

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.estimate import Regression, RegressionRun, find_determined_combinations, solve_least_squares
from tau_dyn.parameters import Parameter, Parameters

NAMES = ("upper.mx", "upper.mz", "fore.mx", "fore.mz", "friction")
TRUTH = np.array([1.0, 0.1, 0.45, 0.03, 2.0])
SIZES = dict.fromkeys(NAMES[:4], 0.3)
HELD_RAD = 0.5


def estimate_moments(spread_rad: float, rng: np.random.Generator):
    """Return the estimate of a lifting joint's moments and friction, with the elbow at 0.5 rad and a spread about it."""
    n, g = 4000, 9.81
    q1, speed = rng.uniform(-1.5, 1.5, n), rng.normal(size=n)
    q2 = q1 + HELD_RAD + spread_rad * rng.normal(size=n)
    W = np.stack([g * np.cos(q1), g * np.sin(q1), g * np.cos(q2), g * np.sin(q2), np.sign(speed)], axis=1)[:, None, :]
    y = W @ TRUTH + 0.1 * rng.normal(size=(n, 1))
    parameters = Parameters(Parameter(name, 0.0, "kg m") for name in NAMES)
    run = RegressionRun("made", np.arange(n) / 100, W, y, np.ones((n, 1), bool), W, y)
    return solve_least_squares(Regression(parameters, ("lift",), ("N m",), (run,)))


def test_moments_about_a_held_elbow_are_summed_with_its_cosine_and_sine(rng):
    """An elbow that shakes by 20 microradian hardly tells the fore arm's moments; rotated into the upper arm they are sums."""
    estimate = estimate_moments(2e-5, rng)
    assert max(estimate.stderr[:4]) > 0.3  # no moment alone is known
    found = find_determined_combinations(estimate, SIZES)
    assert found is not None and found.base.rank == 3
    weights = np.zeros((3, 5))
    weights[range(3), found.base.kept] = 1.0
    weights[:, found.base.dropped] = found.base.K
    c, s = np.cos(HELD_RAD), np.sin(HELD_RAD)
    seen = np.array([[1, 0, c, s, 0], [0, 1, -s, c, 0], [0, 0, 0, 0, 1]])
    assert_allclose(weights, weights[:, [0, 1, 4]] @ seen, atol=1e-4)
    assert np.all(np.abs(found.values - weights @ TRUTH) < 4 * found.stderr)
    assert np.all(found.stderr < 0.01)


def test_what_is_known_by_itself_needs_no_combination(rng):
    """An elbow that moves by 1 rad tells each moment; nothing is to be added up."""
    assert find_determined_combinations(estimate_moments(1.0, rng), SIZES) is None


def test_without_a_prior_no_parameter_is_called_lost(rng):
    """A robot file without masses says nothing, so that any data are better than it."""
    assert find_determined_combinations(estimate_moments(2e-5, rng), {}) is None
