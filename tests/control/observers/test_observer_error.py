"""Intervals of observed tools hold what they promise, also where the model is off and the accelerometer is biased."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from tau_dyn.control.observers import observe_tool, scale_frequencies
from tau_dyn.modes import StateSpace

DT, W, NOISE, STEP = 0.004, 2 * np.pi * 8.0, 0.02, 1e-4  # s, rad/s, m/s^2, m/s


def spring() -> StateSpace:
    """From a cart to a mass behind a spring of 8 Hz, damped by 3 %."""
    whole = expm(np.array([[0, 1, 0], [-(W**2), -0.06 * W, W**2], [0, 0, 0]]) * DT)
    return StateSpace(whole[:2, :2], whole[:2, 2:], np.array([[1.0, 0.0]]), np.zeros((1, 1)), np.zeros((2, 1)), DT)


def log(seed: int, bias: float, n: int = 1000, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cart, acceleration and truth (n, 1) of a move from rest to rest, unknown forces on the mass."""
    rng, model, t = np.random.default_rng(seed), scale_frequencies(spring(), scale), np.arange(n + 2) * DT
    u = 0.015 * (1 - np.cos(2 * np.pi * np.clip((t - 1) / 0.5, 0, 1)))
    x, z = np.zeros(2), np.empty(n + 2)
    for k in range(n + 2):
        z[k] = x[0]
        x = model.A @ x + model.B[:, 0] * u[k] + np.array([0.0, STEP]) * rng.standard_normal()
    a = np.r_[0.0, np.diff(z, 2)[: n - 1]] / DT**2 + NOISE * rng.standard_normal(n) + bias
    return u[:n, None], a[:, None], z[:n, None]


@pytest.mark.parametrize(("off", "bias"), [(1.0, 0.0), (1.0, 0.1), (1.05, 0.0), (1.1, 0.1)])
def test_intervals_hold_the_tool(off, bias) -> None:
    """90 to 98 % of the tool's errors are within the 95 % interval: right model, biased sensor, frequencies 5 and 10 % off."""
    model, hits = scale_frequencies(spring(), off), []
    for seed in range(2):
        u, a, z = log(seed, bias)
        found = observe_tool(["x"], np.arange(len(u)) * DT, u, a, model=model)
        hits.append(np.abs(found.position - z) < 1.96 * found.stderr)
        assert found.error is not None
        assert_allclose(found.error.frequency_scale * off, 1.0, atol=0.015)
        assert_allclose(found.error.bias, bias, atol=0.005)
    assert 0.90 <= np.mean(hits) <= 0.98


@pytest.mark.parametrize("cutoff", [3.0, 4.5, 6.0])
@pytest.mark.parametrize(("scale", "bias"), [(1.0, 0.0), (1.0, 0.1), (1.05, 0.0), (1.1, 0.1)])
def test_intervals_of_the_complementary_filter_hold_the_tool(cutoff, scale, bias) -> None:
    """It has no model: 90 to 98 % of errors are within its interval on springs 0, 5 and 10 % stiffer in frequency, too."""
    hits, sizes = [], []
    for seed in range(3):
        u, a, z = log(seed, bias, scale=scale)
        found = observe_tool(["x"], np.arange(len(u)) * DT, u, a, cutoff_hz=(cutoff,))
        hits.append(np.abs(found.position - z) < 1.96 * found.stderr)
        sizes.append(found.stderr / np.sqrt(np.mean((found.position - z) ** 2, axis=0)))
    assert 0.90 <= np.mean(hits) <= 0.98
    assert_allclose(
        sizes, 1.0, atol=0.1
    )  # the low-pass takes deflection for the carts': no interval of noise alone is as wide


def test_scaled_frequencies_keep_the_static_gain() -> None:
    """Poles become `p^s`; a constant input leads to the same place."""
    plain, scaled = spring(), scale_frequencies(spring(), 1.2)
    assert_allclose(np.sort_complex(np.log(scaled.poles())), 1.2 * np.sort_complex(np.log(plain.poles())), rtol=1e-9)
    assert_allclose(scaled.frequency_response(np.zeros(1)), plain.frequency_response(np.zeros(1)), rtol=1e-9)
