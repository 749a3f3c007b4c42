"""Filters shift nothing in time, derivatives are those of calculus, and masks keep away from reversals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.log import (
    compute_attenuation,
    compute_edge_samples,
    decimate,
    differentiate,
    find_reversals,
    lowpass,
    lowpass_and_decimate,
)

RATE = 1000.0
T = np.arange(4000) / RATE
INNER = slice(300, -300)


def test_a_slow_wave_passes_unshifted():
    """A 2 Hz wave under a 60 Hz low-pass keeps amplitude and phase to 1e-6, in every column."""
    x = np.column_stack([np.sin(4 * np.pi * T), np.cos(4 * np.pi * T)])
    assert_allclose(lowpass(x, 60, RATE)[INNER], x[INNER], atol=1e-6)


def test_half_the_amplitude_passes_at_the_cutoff():
    """Two runs of a Butterworth filter let (1 / sqrt 2)^2 pass; four times higher 4^-8 is left."""
    for frequency, gain in ((60, 0.5), (240, 0.0)):
        y = lowpass(np.sin(2 * np.pi * frequency * T), 60, RATE)[INNER]
        assert_allclose(np.sqrt(2) * y.std(), gain, atol=2e-3)


def test_a_sine_comes_out_smaller_as_attenuation_says():
    """Of 30, 60 and 90 Hz at 1 kHz the low-pass at 60 Hz leaves what the formula says, but for 2 % of the sine."""
    for frequency in (30.0, 60.0, 90.0):
        x = np.sin(2 * np.pi * frequency * T)
        left = lowpass(x, 60, RATE)[INNER].std() / x[INNER].std()
        assert_allclose(left, 1 / compute_attenuation(np.array(frequency), 60.0), atol=0.02)


def test_silence_does_not_fade_into_denormal_numbers():
    """A minute of zeros after one kick: nothing below the smallest normal number is left, which takes long."""
    kick = np.zeros(60_000)
    kick[5] = 1.0
    y = np.abs(lowpass(kick, 100.0, 1000.0))
    assert not np.any((y > 0) & (y < np.finfo(float).tiny))
    assert np.all(y[1000:] < 1e-25)


def test_a_ramp_keeps_its_slope_at_both_ends():
    """Point-symmetric continuation keeps a straight line: 2 um of 8 m are left of the start-up at its far end."""
    assert_allclose(lowpass(3 + 2 * T, 20, RATE), 3 + 2 * T, atol=2e-6)


def test_edge_samples_cover_the_transient():
    """The filter's answer to a knock has decayed to 1 % of its peak beyond them, and not long before."""
    for cutoff in (5, 20, 100):
        knock = np.zeros(4000)
        knock[2000] = 1.0
        answer = np.abs(lowpass(knock, cutoff, RATE))
        edge = compute_edge_samples(cutoff, RATE)
        assert answer[2000 + edge :].max() < 0.01 * answer.max()
        assert answer[2000 + edge // 2 :].max() > 0.01 * answer.max()


@pytest.mark.parametrize("cutoff", [500, 600, 0, -1])
def test_a_cutoff_outside_the_band_is_refused(cutoff):
    """Half the sampling rate is the limit, and the sentence names it."""
    with raises_code("invalid_value", "500"):
        lowpass(T, cutoff, RATE)


def test_a_log_shorter_than_the_transient_is_refused():
    """The sentence says how many samples it takes."""
    with raises_code("invalid_value", f"{compute_edge_samples(20, RATE)}"):
        lowpass(T[:50], 20, RATE)


def test_the_derivative_of_a_parabola_is_exact_even_at_the_ends():
    """Central differences inside and second-order ones at the ends differentiate t^2 without error."""
    assert_allclose(
        differentiate(np.column_stack([T**2, 3 * T]), 1 / RATE), np.column_stack([2 * T, 0 * T + 3]), atol=1e-9
    )


@pytest.mark.parametrize(("accuracy", "error"), [(2, 1.65e-2), (4, 3.3e-4)])
def test_central_differences_fall_short_by_the_known_share(accuracy, error):
    """At 50 Hz and 1 kHz, w dt = 0.314: (w dt)^2 / 6 = 1.6 % is missing, or (w dt)^4 / 30 = 0.03 %."""
    w = 2 * np.pi * 50
    derivative = differentiate(np.sin(w * T), 1 / RATE, accuracy)[2:-2] / w
    missing = 1 - derivative @ np.cos(w * T)[2:-2] / (np.cos(w * T)[2:-2] @ np.cos(w * T)[2:-2])
    assert missing == pytest.approx(error, rel=0.05)


def test_an_unknown_accuracy_is_refused():
    """Two and four exist."""
    with raises_code("invalid_value"):
        differentiate(T, 0.001, 3)


def test_decimation_keeps_the_first_sample():
    """Every 4th of 10 samples: 0, 4, 8."""
    assert_array_equal(decimate(np.arange(10), 4), [0, 4, 8])
    with raises_code("invalid_value"):
        decimate(T, 0)


def test_reversals_ignore_noise_below_the_threshold(rng):
    """One stroke back and forth has one reversal, whatever trembles at rest."""
    v = np.concatenate([np.ones(100), 0.01 * rng.standard_normal(50), -np.ones(100)])
    assert_array_equal(find_reversals(v, 0.1), [150])


@pytest.mark.parametrize(
    ("rate", "cutoff", "factor", "n"), [(1000.0, 30.0, 13, 20_003), (250.0, 32.0, 3, 4000), (250.0, 32.0, 3, 90)]
)
def test_samples_kept_of_a_product_are_those_of_the_recursive_filter(rate, cutoff, factor, n):
    """Convolution and recursion are one filter: 1e-10 of the largest sample apart, at both ends too, and of short logs."""
    x = 100 + np.random.default_rng(1).normal(size=(n, 2)).cumsum(axis=0)
    kept = lowpass_and_decimate(x, cutoff, rate, factor)
    assert_allclose(kept, decimate(lowpass(x, cutoff, rate), factor), rtol=0, atol=1e-10 * np.abs(x).max())
    assert_array_equal(kept[:, 1], lowpass_and_decimate(x[:, 1], cutoff, rate, factor))
