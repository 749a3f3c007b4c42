"""The noise found in a log is the noise that was put in, whatever the joint did."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.log import (
    compute_edge_samples,
    compute_noise_gain,
    differentiate,
    estimate_encoder_noise,
    estimate_quantisation_step,
    lowpass,
)

RATE = 1000.0
T = np.arange(20000) / RATE


def true_velocity_noise(noisy, clean, cutoff) -> float:
    """Return the standard deviation of what filtering and differentiating make of the difference."""
    edge = compute_edge_samples(cutoff, RATE)
    return differentiate(lowpass(noisy - clean, cutoff, RATE), 1 / RATE)[edge:-edge].std()


@pytest.mark.parametrize("sigma", [5e-6, 20e-6])
@pytest.mark.parametrize("cutoff", [20, 60])
def test_white_noise_is_found_in_a_moving_log(motion, rng, sigma, cutoff):
    """5 and 20 um on a half-metre stroke: level to 3 %, velocity to 10 % (its own scatter is 3 % at 20 Hz)."""
    q = motion(T)
    noisy = q + sigma * rng.standard_normal(T.size)
    assert_allclose(estimate_encoder_noise(noisy), sigma, rtol=0.03)
    assert_allclose(
        estimate_encoder_noise(noisy) * compute_noise_gain(RATE, cutoff),
        true_velocity_noise(noisy, q, cutoff),
        rtol=0.1,
    )


@pytest.mark.parametrize("step", [5e-6, 2e-5, 1e-4])
def test_quantisation_counts_as_noise(motion, step):
    """Rounding to a grid is found, and makes the velocity noise of step / sqrt(12)."""
    q = motion(T)
    rounded = np.round(q / step) * step
    assert_allclose(estimate_quantisation_step(rounded), step, rtol=1e-6)
    assert_allclose(estimate_encoder_noise(rounded), step / np.sqrt(12), rtol=0.05)
    assert_allclose(
        estimate_encoder_noise(rounded) * compute_noise_gain(RATE, 60), true_velocity_noise(rounded, q, 60), rtol=0.15
    )


def test_rest_knocks_and_a_resonance_do_not_hide_the_noise(rng):
    """Half the time at rest, trapezoidal speeds, three knocks and a 300 Hz line change the level by less than 10 %."""
    v = np.clip(0.8 * np.sin(0.4 * np.pi * T), -0.3, 0.3) * (np.sin(0.1 * np.pi * T) > 0)
    q = np.cumsum(v) / RATE + 2e-6 * np.sin(2 * np.pi * 300 * T)
    q[[3000, 9000, 15000]] += 1e-3
    assert_allclose(estimate_encoder_noise(q + 5e-6 * rng.standard_normal(T.size)), 5e-6, rtol=0.1)
    step = 1e-5
    assert_allclose(estimate_encoder_noise(np.round(q / step) * step), step / np.sqrt(12), rtol=0.1)


def test_a_joint_that_mostly_rests_is_judged_by_its_motion(motion, rng):
    """Four fifths of the time the encoder says exactly the same; the noise is that of the rest."""
    noisy = motion(T) + 2e-5 * rng.standard_normal(T.size)
    noisy[4000:] = noisy[4000]
    assert_allclose(estimate_encoder_noise(noisy), 2e-5, rtol=0.1)


def test_joints_are_judged_one_by_one(motion, rng):
    """Two columns, two levels."""
    noise = rng.standard_normal((T.size, 2)) * [5e-6, 5e-5]
    assert_allclose(estimate_encoder_noise(motion(T)[:, None] + noise), [5e-6, 5e-5], rtol=0.05)


def test_unrounded_positions_have_no_step(motion, rng):
    """White noise stands on no grid."""
    assert estimate_quantisation_step(motion(T) + 1e-5 * rng.standard_normal(T.size)) == 0.0
    assert estimate_quantisation_step(np.zeros(100)) == 0.0


@pytest.mark.parametrize("derivatives", [1, 2])
def test_the_noise_gain_is_what_filtering_does(rng, derivatives):
    """White noise of 1 through the filter and one or two derivatives: the formula agrees to 5 %."""
    y = lowpass(rng.standard_normal(200000), 30, RATE)
    for _ in range(derivatives):
        y = differentiate(y, 1 / RATE)
    assert_allclose(y[500:-500].std(), compute_noise_gain(RATE, 30, derivatives=derivatives), rtol=0.05)
