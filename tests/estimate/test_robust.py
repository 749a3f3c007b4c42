"""Bisquare weights: what they leave out, and how much less certain they make an estimate."""

import numpy as np
import pytest

from tau_dyn.estimate import compute_bisquare_weights, compute_robust_covariance_factor, estimate_robust_scale
from tau_dyn.estimate.weights import BISQUARE


def test_far_samples_weigh_nothing_and_near_ones_all():
    """Weights fall from one at zero to nothing at 4.685 deviations."""
    assert np.allclose(compute_bisquare_weights(np.array([0.0, BISQUARE, -7.0])), [1.0, 0.0, 0.0])
    assert 0.9 < compute_bisquare_weights(np.array([1.0]))[0] < 0.92


def test_a_tenth_of_wild_samples_moves_the_scale_little():
    """The median deviation of normal noise is its deviation; one wild sample in ten raises it by less than a fifth."""
    rng = np.random.default_rng(0)
    x = rng.normal(scale=3.0, size=(20_000, 1))
    mask = np.ones_like(x, bool)
    assert estimate_robust_scale(x, mask)[0] == pytest.approx(3.0, rel=0.03)
    wild = np.where(rng.random(x.shape) < 0.1, 1e6, x)
    assert estimate_robust_scale(wild, mask)[0] < 3.6


def test_the_inflation_is_that_of_a_repeated_fit():
    """The mean of normal noise, by weights repeated until they settle, scatters as `inflation` says."""
    rng = np.random.default_rng(1)
    means, said = [], []
    for _ in range(400):
        x, centre = rng.normal(size=400), 0.0
        for _ in range(20):
            w = compute_bisquare_weights(x - centre)
            centre = np.sum(w * x) / np.sum(w)
        means.append(centre)
        e = x - centre
        w = compute_bisquare_weights(e)
        said.append(compute_robust_covariance_factor(e) * np.sqrt(np.sum((w * e) ** 2)) / np.sum(w))
    assert np.mean(said) == pytest.approx(np.std(means), rel=0.1)
    assert np.std(means) * 20 == pytest.approx(1 / np.sqrt(0.95), rel=0.1)
