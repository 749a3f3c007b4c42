"""A complementary filter takes each sensor where it is good, and shifts nothing."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.signal import butter, filtfilt

from tau_dyn.control.observers import ComplementaryToolObserver, tune_complementary

DT = 0.004
T = np.arange(2000) * DT
CUTOFF = (4.5, 2.63)


def sway(frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth burst of 1 mm and its acceleration, in both axes."""
    envelope = np.exp(-(((T - 4) / 0.8) ** 2))
    z = 1e-3 * envelope * np.sin(2 * np.pi * frequency * T)
    a = np.zeros_like(z)
    a[1:-1] = np.diff(z, 2) / DT**2
    return np.column_stack([z, z]), np.column_stack([a, a])


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("frequency", [0.5, 3.0, 12.0])
def test_two_perfect_sensors_give_the_truth_at_every_frequency(causal, frequency) -> None:
    """G + (1 - G) = 1: where both sensors agree the estimate is what they say, without a shift in time."""
    z, a = sway(frequency)
    assert_allclose(ComplementaryToolObserver(CUTOFF, DT, causal).estimate(z, a), z, atol=4e-5)


@pytest.mark.parametrize("causal", [False, True])
def test_a_constant_error_of_the_accelerometer_leaves_no_trace(causal) -> None:
    """Integrated twice a bias of 0.1 m/s^2 is 3.2 m after 8 s; the filter's zeros take it away."""
    still = np.zeros((2000, 2))
    z = ComplementaryToolObserver(CUTOFF, DT, causal).estimate(still, still + 0.1)
    assert np.abs(z[600:1400]).max() < 1e-7


def test_zero_phase_filter_is_filtfilt_of_the_thesis() -> None:
    """Low-passed positions equal scipy's `filtfilt` with a second-order Butterworth filter, away from the ends."""
    z, _ = sway(2.0)
    ours = ComplementaryToolObserver(CUTOFF, DT).estimate(z, np.zeros_like(z))
    theirs = np.column_stack([filtfilt(*butter(2, f, fs=1 / DT), z[:, k]) for k, f in enumerate(CUTOFF)])
    assert_allclose(ours[300:-300], theirs[300:-300], atol=1e-8)


def test_what_the_carts_do_not_see_comes_from_the_accelerometer() -> None:
    """A sway at 12 Hz, well above the cutoff, is found although forward kinematics knows nothing of it."""
    z, a = sway(12.0)
    found = ComplementaryToolObserver(CUTOFF, DT).estimate(np.zeros_like(z), a)
    assert np.linalg.norm(found - z) < 0.05 * np.linalg.norm(z)


def test_stated_error_is_that_of_the_sensors_noise() -> None:
    """Pure noise of both sensors scatters the estimate as `standard_error` says."""
    rng = np.random.default_rng(1)
    observer = ComplementaryToolObserver(CUTOFF, DT)
    scatter = observer.estimate(1e-5 * rng.standard_normal((40_000, 2)), 0.07 * rng.standard_normal((40_000, 2)))
    assert_allclose(scatter[500:-500].std(axis=0), observer.standard_error(1e-5, 0.07), rtol=0.1)


@pytest.mark.parametrize("causal", [False, True])
def test_operators_and_responses_are_those_of_the_filter(causal, rng) -> None:
    """The matrices that stability is judged with do what the observer does; their transposes are transposes."""
    observer = ComplementaryToolObserver(CUTOFF, DT, causal)
    z, a = rng.standard_normal((2, 80, 2))
    z[0] = 0
    slow, fast = observer.operators(80)
    assert_allclose((slow @ z.T.ravel() + fast @ a.T.ravel()).reshape(2, -1).T, observer.estimate(z, a), atol=1e-12)
    assert_allclose(slow.T @ np.eye(160), (slow @ np.eye(160)).T, atol=1e-12)
    f = np.array([0.01, 2.0, 40.0])
    G, H = observer.responses(f)
    second = -((2 * np.pi * f) ** 2)
    assert_allclose((G + H * second[:, None, None])[:2], np.tile(np.eye(2), (2, 1, 1)), atol=2e-3)


def test_tuning_finds_where_the_sensors_change_places() -> None:
    """Carts blind above 6 Hz and a noisy accelerometer: the tuned cutoff beats a tenth and ten times of it."""
    rng = np.random.default_rng(2)
    slow, fast = sway(1.0), sway(9.0)
    truth, a = slow[0] + fast[0], slow[1] + fast[1] + 0.05 * rng.standard_normal((2000, 2))
    best = tune_complementary(slow[0], a, truth, DT)

    def error(cutoff: tuple[float, ...]) -> float:
        return float(np.linalg.norm(ComplementaryToolObserver(cutoff, DT).estimate(slow[0], a) - truth))

    assert 1.0 < min(best.cutoff_hz) and max(best.cutoff_hz) < 9.0
    assert error(best.cutoff_hz) < 0.5 * min(error(tuple(f * k for f in best.cutoff_hz)) for k in (0.1, 10))


def test_impossible_settings_are_refused() -> None:
    """A cutoff above half the sampling rate, signals that do not fit, and numbers that are none."""
    with raises_code("invalid_value", "130"):
        ComplementaryToolObserver((130.0,), DT)
    observer = ComplementaryToolObserver(CUTOFF, DT)
    with raises_code("wrong_shape", "2"):
        observer.estimate(np.zeros((10, 3)), np.zeros((10, 3)))
    with raises_code("bad_sample"):
        observer.estimate(np.full((10, 2), np.nan), np.zeros((10, 2)))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
