"""Where a motion lives in frequency, read off the log."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.log import choose_force_cutoff, find_motion_band

RATE = 500.0
T = np.arange(0, 30, 1 / RATE)


def test_the_band_ends_at_the_highest_line_of_the_motion(rng):
    """Of lines at 0.3, 1.1 and 3 Hz with micrometre noise, the band reaches 3 Hz to the windows' resolution."""
    q = sum(a * np.sin(2 * np.pi * f * T) for a, f in ((0.1, 0.3), (0.03, 1.1), (0.005, 3.0)))
    band = find_motion_band((q + rng.normal(0, 1e-6, len(T)))[:, None], RATE)
    assert 2.9 < band.edge_hz[0] < 4.0


@pytest.mark.parametrize("sigma", [1e-6, 2e-5])
def test_the_encoder_noise_is_read_under_a_large_motion(rng, sigma):
    """Noise 10^4 times smaller than the motion is found to 10 %: the motion does not leak into the upper band."""
    q = 0.3 * np.sin(2 * np.pi * 0.5 * T) + rng.normal(0, sigma, len(T))
    assert_allclose(find_motion_band(q[:, None], RATE).encoder_noise, sigma, rtol=0.1)


def test_a_joint_at_rest_has_no_band(rng):
    """Noise alone is no motion."""
    assert find_motion_band(rng.normal(0, 1e-6, (len(T), 1)), RATE).edge_hz[0] < 0.5


def test_more_noise_narrows_what_a_regressor_may_keep(rng):
    """The noise edge falls as the encoder gets worse: noise in the columns would bias the fit."""
    q = 0.1 * np.sin(2 * np.pi * T)
    noise = rng.normal(0, 1e-6, len(T))
    edges = [find_motion_band((q + k * noise)[:, None], RATE).noise_edge_hz[0] for k in (1, 20)]
    assert edges[1] < 0.6 * edges[0]


@pytest.mark.parametrize(("size", "sigma"), [(0.1, 1e-6), (0.1, 1e-5), (0.02, 1e-5)])
def test_the_noise_edge_is_where_noise_has_a_ten_thousandth_of_the_accelerations_power(rng, size, sigma):
    """Of a sine: `A^2 w^4 / 2` times 1e-4 is the noise's power in second differences up to there, by its integral on paper."""
    q = size * np.sin(2 * np.pi * 2 * T) + sigma * rng.normal(size=len(T))
    f = np.linspace(0, RATE / 2, 100_001)
    density = (2 * np.sin(np.pi * f / RATE)) ** 4 * RATE**4 * 2 * sigma**2 / RATE
    power = np.cumsum(density) * f[1]
    edge = f[np.searchsorted(power, 1e-4 * size**2 * (4 * np.pi) ** 4 / 2)]
    assert_allclose(find_motion_band(q[:, None], RATE).noise_edge_hz, edge, rtol=0.02)


def test_bands_do_not_depend_on_the_unit(rng):
    """Metres, millimetres or thousands of kilometres: the same frequencies, and noise in that unit; joint by joint."""
    q = np.column_stack([0.1 * np.sin(2 * np.pi * 1.3 * T), 0.01 * np.sin(2 * np.pi * 4 * T) + 0.05 * np.sin(3 * T)])
    q = q + [1e-6, 1e-5] * rng.normal(size=q.shape)
    plain = find_motion_band(q, RATE)
    for unit in (1e-6, 1e3, 1e6):
        other = find_motion_band(unit * q, RATE)
        for name in ("edge_hz", "noise_edge_hz", "signal_edge_hz", "clear_edge_hz"):
            assert_allclose(getattr(other, name), getattr(plain, name), err_msg=name)
        assert_allclose(other.encoder_noise, unit * plain.encoder_noise)
    for k in range(2):
        assert_allclose(find_motion_band(q[:, [k]], RATE).noise_edge_hz, plain.noise_edge_hz[k])


def test_a_coloured_motion_stands_out_as_far_as_it_exceeds_the_noise(rng):
    """White force on a mass: `S / f^4` in position against white noise; ten and 300 times above it, by the crossing on paper."""
    n = 2**17
    f = np.fft.rfftfreq(n, 1 / RATE)
    shape = np.where(f > 0.3, 1 / np.maximum(f, 0.3) ** 2, 0)
    motion = np.fft.irfft(np.fft.rfft(rng.normal(size=n)) * shape)  # density 2 / rate / f^4
    sigma = 1e-3  # noise of density 2 sigma^2 / rate: as large as the motion at `sigma f^2 = 1`
    band = find_motion_band((motion + sigma * rng.normal(size=n))[:, None], RATE)
    for found, least in ((band.signal_edge_hz[0], 10.0), (band.clear_edge_hz[0], 300.0)):
        crossing = sigma**-0.5 * (least - 1) ** -0.25  # motion and noise together stand so far above the noise
        assert_allclose(found, crossing, rtol=0.15)


def test_a_slow_log_next_to_a_fast_one_limits_the_force_filter(rng):
    """Motion up to 7 Hz in one log, another one at 12 Hz: forces are low-passed below the 6 Hz that it resolves."""
    q = 0.1 * np.sin(2 * np.pi * 0.5 * T) + 0.02 * np.sin(2 * np.pi * 7 * T) + rng.normal(0, 1e-6, len(T))
    band = find_motion_band(q[:, None], RATE)
    assert band.edge_hz[0] > 6.5
    assert choose_force_cutoff([band], 12.0) < 6.0 < choose_force_cutoff([band], RATE)
