"""Where a motion lives in frequency, read off the log."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.log import motion_band

RATE = 500.0
T = np.arange(0, 30, 1 / RATE)


def test_the_band_ends_at_the_highest_line_of_the_motion(rng):
    """Of lines at 0.3, 1.1 and 3 Hz with micrometre noise, the band reaches 3 Hz to the windows' resolution."""
    q = sum(a * np.sin(2 * np.pi * f * T) for a, f in ((0.1, 0.3), (0.03, 1.1), (0.005, 3.0)))
    band = motion_band((q + rng.normal(0, 1e-6, len(T)))[:, None], RATE)
    assert 2.9 < band.edge_hz[0] < 4.0


@pytest.mark.parametrize("sigma", [1e-6, 2e-5])
def test_the_encoder_noise_is_read_under_a_large_motion(rng, sigma):
    """Noise 10^4 times smaller than the motion is found to 10 %: the motion does not leak into the upper band."""
    q = 0.3 * np.sin(2 * np.pi * 0.5 * T) + rng.normal(0, sigma, len(T))
    assert_allclose(motion_band(q[:, None], RATE).encoder_noise, sigma, rtol=0.1)


def test_a_joint_at_rest_has_no_band(rng):
    """Noise alone is no motion."""
    assert motion_band(rng.normal(0, 1e-6, (len(T), 1)), RATE).edge_hz[0] < 0.5


def test_more_noise_narrows_what_a_regressor_may_keep(rng):
    """The noise edge falls as the encoder gets worse: noise in the columns would bias the fit."""
    q = 0.1 * np.sin(2 * np.pi * T)
    noise = rng.normal(0, 1e-6, len(T))
    edges = [motion_band((q + k * noise)[:, None], RATE).noise_edge_hz[0] for k in (1, 20)]
    assert edges[1] < 0.6 * edges[0]
