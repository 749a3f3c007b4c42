"""Linear systems: exact sampling, delays, and stepping one sample at a time."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code
from scipy.integrate import solve_ivp

from tau_dyn.mechanism import ContinuousModel, PositionDrives

W, ZETA = 2 * np.pi * 3, 0.1


def oscillator(delay: float = 0.0) -> ContinuousModel:
    A, B = np.array([[0, 1], [-(W**2), -2 * ZETA * W]]), np.array([[0], [W**2]])
    return ContinuousModel(A, B, np.array([[1.0, 0]]), np.zeros((1, 1)), ("u",), ("y",), np.array([delay]))


def test_sampling_agrees_with_a_fine_integration(rng: np.random.Generator) -> None:
    """Under a held input the sampled outputs are the continuous ones, not an approximation."""
    model, dt = oscillator(), 0.02
    u = rng.standard_normal((30, 1))
    x, y = np.zeros(2), []
    for k in range(30):
        y.append(x[0])
        field = lambda t, x, k=k: model.A @ x + model.B @ u[k]  # noqa: E731
        x = solve_ivp(field, (0, dt), x, rtol=1e-11, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(model.sampled(dt).simulate(u)[:, 0], y, atol=1e-9)


def test_a_delay_shifts_the_output_and_turns_the_phase() -> None:
    u = np.zeros((40, 1))
    u[3] = 1
    on_time, late = (oscillator(d).sampled(0.01).simulate(u)[:, 0] for d in (0.0, 0.04))
    np.testing.assert_allclose(late[4:], on_time[:-4])
    f = np.array([0.5, 2.0])
    turned = oscillator(0.04).frequency_response(f) / oscillator().frequency_response(f)
    np.testing.assert_allclose(np.angle(turned[:, 0, 0]), -2 * np.pi * f * 0.04)


@pytest.mark.parametrize("n", [3, 5, 8])
def test_a_delay_longer_than_the_inputs_leaves_the_system_at_rest(n: int) -> None:
    """What has not arrived yet moves nothing, whether the delay is a little or much longer than what is simulated."""
    sampled = oscillator(0.08).sampled(0.01)
    np.testing.assert_array_equal(sampled.simulate(np.ones((n, 1))), np.zeros((n, 1)))


def test_what_cannot_be_sampled_is_refused() -> None:
    with raises_code("invalid_value"):
        oscillator(0.005).sampled(0.004)
    with raises_code("invalid_value", "positive"):
        oscillator().sampled(0.0)
    with raises_code("unknown_name", "w"):
        oscillator().select(["w"], ["y"])
    with raises_code("wrong_shape", "shape"):
        oscillator().sampled(0.01).simulate(np.zeros(5))


def test_printed_drives_come_back_when_sampled() -> None:
    """Sampling the lag and delay gives q^-5 (1 - a) / (1 - a q^-1), the form of (6.11)."""
    a, dt = 0.9647, 0.004
    drives = PositionDrives.from_sampled([a], dt, 5)
    lag = 1 / drives.time_constants[0]
    one = np.ones((1, 1))
    model = ContinuousModel(-lag * one, lag * one, one, 0 * one, ("r",), ("q",), np.array([drives.delay]))
    u = np.zeros((12, 1))
    u[0] = 1
    expected = np.zeros(12)
    expected[5:] = (1 - a) * a ** np.arange(7)
    np.testing.assert_allclose(model.sampled(dt).simulate(u)[:, 0], expected, atol=1e-14)
    assert -np.log(a) / dt / (2 * np.pi) == pytest.approx(
        1.43, abs=0.01
    )  # a bandwidth in Hz; the thesis says about 1.1
