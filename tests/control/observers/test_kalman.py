"""The Kalman filter on a flexible axis: a mass on a spring behind a cart."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.linalg import expm, solve_discrete_are

from tau_dyn.control.observers import KalmanToolObserver, check_whiteness, extend_model, log_likelihood, tune_kalman
from tau_dyn.modes import StateSpace

DT = 0.004
W, ZETA = 2 * np.pi * 8.0, 0.03
NOISE = 0.02  # m/s^2
STEP = 1e-4  # m/s, velocity that unknown forces give in a step


def spring(direct: float = 0.0) -> StateSpace:
    """From the cart to the mass behind its spring; a part of the cart's motion may reach the tool at once."""
    A = np.array([[0, 1], [-(W**2), -2 * ZETA * W]])
    whole = expm(np.block([[A, np.array([[0.0], [W**2]])], [np.zeros((1, 3))]]) * DT)
    C, D = np.array([[1.0 - direct, 0.0]]), np.array([[direct]])
    return StateSpace(whole[:2, :2], whole[:2, 2:], C, D, np.zeros((2, 1)), DT)


def log(seed: int, n: int = 2000, direct: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cart, acceleration and truth, with unknown forces on the mass."""
    rng, model = np.random.default_rng(seed), spring(direct)
    t = np.arange(n + 2) * DT
    u = 1e-3 * np.sin(2 * np.pi * 1.3 * t) * np.clip(t, 0, 1)
    x, z = np.zeros(2), np.empty(n + 2)
    for k in range(n + 2):
        z[k] = model.C[0] @ x + model.D[0, 0] * u[k]
        x = model.A @ x + model.B[:, 0] * u[k] + np.array([0.0, 1.0]) * STEP * rng.standard_normal()
    a = (z[2:] - 2 * z[1:-1] + z[:-2]) / DT**2  # at samples 1 to n
    acceleration = np.concatenate([[0.0], a[: n - 1]]) + NOISE * rng.standard_normal(n)
    return u[:n, None], acceleration[:, None], z[:n, None]


def test_extended_matrices_are_the_printed_ones() -> None:
    """(7.21) block by block, for a model without a direct part."""
    m, e = spring(), extend_model(spring())
    differ = m.C @ (m.A - np.eye(2)) / DT
    assert not e.ahead
    assert_allclose(e.A, np.block([[m.A, np.zeros((2, 2))], [differ, 0, 0], [differ / DT, -1 / DT, 0]]))
    assert_allclose(e.B, np.vstack([m.B, m.C @ m.B / DT, m.C @ m.B / DT**2]))


@pytest.mark.parametrize("direct", [0.0, -0.25])
def test_acceleration_state_is_the_acceleration_one_sample_before(direct) -> None:
    """Second differences of the position: x_a at a sample belongs to the sample before it, with a direct part too."""
    e = extend_model(spring(direct))
    u = np.sin(0.05 * np.arange(60.0))
    x, z, a = np.zeros(len(e.A)), [], []
    for k in range(1, 60):
        x = e.A @ x + e.B[:, 0] * (u[k] if e.ahead else u[k - 1])
        z.append(e.position[0] @ x)
        a.append(e.acceleration[0] @ x)
    assert_allclose(a[2:], np.diff(z, 2) / DT**2, rtol=1e-9)


def test_gain_is_that_of_the_riccati_equation() -> None:
    """K = A P Cy' (Cy P Cy' + R2)^-1 with P from scipy's solver, for the thesis' R1 = r I."""
    r = 1e-6 * np.eye(4)
    observer, e = KalmanToolObserver(spring(), r, NOISE**2), extend_model(spring())
    P = solve_discrete_are(e.A.T, e.acceleration.T, r, NOISE**2 * np.eye(1))
    S = e.acceleration @ P @ e.acceleration.T + NOISE**2
    assert_allclose(observer.gain, e.A @ P @ e.acceleration.T / S, rtol=1e-10)
    assert np.abs(np.linalg.eigvals(e.A - observer.gain @ e.acceleration)).max() < 1


@pytest.mark.parametrize("direct", [0.0, -0.25])
@pytest.mark.parametrize("predict", [False, True])
def test_filters_do_what_the_observer_does(direct, predict, rng) -> None:
    """F_y of (7.4), with which stability is judged, gives the same estimates sample by sample."""
    observer = KalmanToolObserver(spring(direct), 1e-12, NOISE**2, predict=predict)
    u, a = rng.standard_normal((2, 50, 1))
    u[0] = 0
    slow, fast = observer.operators(50)
    assert_allclose(slow @ u.ravel() + fast @ a.ravel(), observer.estimate(u, a).ravel(), atol=1e-10)


def test_unknown_forces_are_seen_by_the_accelerometer() -> None:
    """Tuned without the tool's position, the filter halves the model's error and states its own within 15 %."""
    tuned = tune_kalman(spring(), *log(1)[:2])
    u, a, z = log(2)
    left = (tuned.observer.estimate(u, a) - z).std()
    blind = (KalmanToolObserver(spring(), 1e-24, NOISE**2).estimate(u, a) - z).std()
    assert left < 0.5 * blind
    assert_allclose(tuned.observer.standard_error()[0], left, rtol=0.15)
    assert_allclose(np.sqrt(tuned.observer.R2[0, 0]), NOISE, rtol=0.25)  # a force looks much like it in one sample
    assert tuned.whiteness.p_value[0] > 1e-3


def test_likelihood_knows_the_best_filter() -> None:
    """The likelihood, which knows no tool position, prefers the noise that leaves the smallest error of the tool."""
    u, a, z = log(3)
    tried = [KalmanToolObserver(spring(), (STEP * DT) ** 2 * factor, NOISE**2) for factor in (1 / 30, 1.0, 30.0)]
    errors = [(k.estimate(u, a) - z).std() for k in tried]
    assert int(np.argmin(errors)) == int(np.argmax([log_likelihood(k, u, a) for k in tried])) == 1


def test_alignment_matters() -> None:
    """Compared with the present sample, as (7.21) is printed, the acceleration is one sample off and less likely."""
    u, a, z = log(4)
    tuned = KalmanToolObserver(spring(), (STEP * DT) ** 2, NOISE**2)
    printed = KalmanToolObserver(spring(), (STEP * DT) ** 2, NOISE**2, aligned=False)
    assert (tuned.estimate(u, a) - z).std() < 0.95 * (printed.estimate(u, a) - z).std()
    assert log_likelihood(tuned, u, a) > log_likelihood(printed, u, a)


def test_whiteness_tells_white_from_coloured(rng) -> None:
    """White innovations pass at one in a thousand, first-order coloured ones do not; their size is compared too."""
    white = rng.standard_normal((4000, 1))
    assert check_whiteness(white, np.eye(1)).p_value[0] > 1e-3
    assert_allclose(check_whiteness(white, np.eye(1)).ratio, 1, atol=0.05)
    assert check_whiteness(white[1:] + 0.3 * white[:-1], np.eye(1)).p_value[0] < 1e-6


def test_impossible_settings_are_refused() -> None:
    """An unstable model, noise that is no covariance, a sensor without noise, signals that do not fit."""
    bad = StateSpace(1.1 * np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), np.zeros((2, 1)), DT)
    with raises_code("unstable", "unstable"):
        KalmanToolObserver(bad, 1e-12, 1.0)
    with raises_code("invalid_value", "covariance"):
        KalmanToolObserver(spring(), -1.0, 1.0)
    with raises_code("invalid_value", "positive"):
        KalmanToolObserver(spring(), 1e-12, 0.0)
    with raises_code("wrong_shape", "1"):
        KalmanToolObserver(spring(), 1e-12, 1.0).estimate(np.zeros((9, 2)), np.zeros((9, 2)))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
