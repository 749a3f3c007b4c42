"""First-order actuators with a dead time: exact sampling, and the fit from step responses."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.modes import Actuator, Record
from tau_dyn.modes.actuators import ActuatorFit, fit_actuators

DT = 0.004
PRINTED = [(0.03527, 0.9647), (0.03425, 0.9656), (0.02748, 0.9728)]  # (6.11), all with q^-5
TRUTH = Actuator(0.98, 0.12, 0.0173)
T = np.arange(1000) * DT


def steps(actuator: Actuator, t: np.ndarray, at: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return reference and position for steps (time, height), from the closed form."""
    reference, position = np.zeros(len(t)), np.zeros(len(t))
    for time, height in at:
        first = int(np.argmax(t >= time))
        late = np.maximum(t - t[first] - actuator.delay, 0)
        reference[first:] += height
        position += actuator.gain * height * (1 - np.exp(-late / actuator.time_constant))
    return reference, position


def fit_one(reference: np.ndarray, position: np.ndarray) -> ActuatorFit:
    """Return the fit of one axis from one test."""
    (found,) = fit_actuators([Record(reference[:, None], position[:, None], DT, ("reference",), ("position",))])
    return found


def test_sampling_is_exact_between_samples() -> None:
    """A delay of 4.3 samples gives the closed form's values to rounding."""
    reference, position = steps(TRUTH, T, [(0.5, 1.5), (2.0, -3.0)])
    assert_allclose(TRUTH.simulate(reference, DT), position, atol=1e-12)


def test_the_thesis_models_have_their_bandwidths() -> None:
    """(6.11) is 1.43, 1.39 and 1.10 Hz: the 1.1 Hz of the text fit the third alone; the dead time is 16 ms."""
    found = [Actuator.from_discrete(b, a, 5, DT) for b, a in PRINTED]
    assert_allclose([each.bandwidth_hz for each in found], [1.43, 1.39, 1.10], atol=0.005)
    assert_allclose([each.delay for each in found], 0.016)
    for each, (b, a) in zip(found, PRINTED, strict=True):
        weights, pole, d = each.discrete(DT)
        assert_allclose(weights, [b, 0], atol=1e-12)
        assert_allclose((pole, d), (a, 5))


def test_the_difference_equation_is_the_thesis_one() -> None:
    """y_k = a y_{k-1} + b r_{k-5}."""
    b, a = PRINTED[0]
    reference = np.random.default_rng(0).normal(size=60)
    reference[0] = 0.0
    y = np.zeros(60)
    for k in range(1, 60):
        y[k] = a * y[k - 1] + (b * reference[k - 5] if k >= 5 else 0.0)
    assert_allclose(Actuator.from_discrete(b, a, 5, DT).simulate(reference, DT), y, atol=1e-12)


def test_the_gain_drops_by_three_decibels_at_the_bandwidth() -> None:
    """A sine at the bandwidth comes out at 0.707 of its static size."""
    plant = Actuator(2.0, 0.05, 0.01)
    t = np.arange(8000) * 5e-4
    out = plant.simulate(np.sin(2 * np.pi * plant.bandwidth_hz * t), 5e-4)[4000:]
    assert_allclose(np.ptp(out) / 2, 2.0 / np.sqrt(2), rtol=2e-3)


def test_three_steps_give_back_the_axes() -> None:
    """Steps of 1, 1.5 and 2 mm (thesis 6.3) under 2 um of noise: all three axes within four small standard errors."""
    truth = [Actuator.from_discrete(b, a, 5, DT) for b, a in PRINTED]
    rng, records = np.random.default_rng(1), []
    for height in (1.0, 1.5, 2.0):
        pairs = [steps(each, T, [(0.4, height)]) for each in truth]
        u, y = (np.column_stack(columns) for columns in zip(*pairs, strict=True))
        records.append(Record(u, 700 + y + 2e-3 * rng.normal(size=y.shape), DT, ("r1", "r2", "r3"), ("q1", "q2", "q3")))
    for found, right in zip(fit_actuators(records), truth, strict=True):
        assert found.fit_percent > 99
        for name in ("gain", "time_constant", "delay"):
            error = abs(getattr(found.actuator, name) - getattr(right, name))
            assert error < 4 * getattr(found.stderr, name)
        assert found.stderr.delay < 0.1 * DT and found.bandwidth_stderr_hz < 0.01


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_standard_errors_cover(colour: float) -> None:
    """Errors over standard errors scatter by about one, for white and for coloured noise."""
    rng, t = np.random.default_rng(2), T[:500]
    reference, position = steps(TRUTH, t, [(0.3, 1.5), (1.2, -2.0)])
    scores = []
    for _ in range(16):
        e = rng.normal(size=len(t) + 50)
        for k in range(1, len(e)):
            e[k] += colour * e[k - 1]
        found = fit_one(reference, position + 0.02 * e[50:])
        scores.append([(getattr(found.actuator, n) - getattr(TRUTH, n)) / getattr(found.stderr, n)
                       for n in ("gain", "time_constant", "delay")])  # fmt: skip
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.35


def test_a_test_that_starts_in_motion_is_no_harm() -> None:
    """What is left of an earlier motion is fitted, not mistaken for dynamics."""
    reference, position = steps(TRUTH, T, [(0.2, 1.0), (0.5, 1.5)])
    found = fit_one(reference[60:], position[60:] + 1e-4 * np.random.default_rng(0).normal(size=940))
    assert_allclose(found.actuator.time_constant, TRUTH.time_constant, rtol=0.005)
    assert_allclose(found.actuator.delay, TRUTH.delay, atol=0.05 * DT)


def test_tests_without_an_answer_are_refused() -> None:
    """No step, no following, or faulty columns: one sentence each."""
    reference, position = steps(TRUTH, T, [(0.5, 1.0)])
    noise = np.random.default_rng(0).normal(size=len(T))
    with raises_code("poor_excitation"):
        fit_one(np.ones(len(T)), position)
    with raises_code("mismatch"):
        fit_one(reference, -position + 1e-3 * noise)
    with raises_code("bad_sample"):
        fit_one(reference, np.where(T > 1, np.nan, position))
    with raises_code("mismatch"):
        fit_actuators([Record(np.ones((9, 1)), np.ones((9, 2)), DT, ("a",), ("b", "c"))])
    with raises_code("invalid_value"):
        Actuator.from_discrete(0.1, 1.2, 5, DT)


def test_a_delay_of_whole_samples_is_no_trap() -> None:
    """Steps in metres with a micrometre of noise: 4 samples of delay come back, although the response has a kink there."""
    rng, dt, truth = np.random.default_rng(63), 0.004, Actuator(1.0, 0.1113, 0.016)
    records = []
    for amplitude in (1e-3, 1.5e-3, 2e-3):
        r = np.where(np.arange(600) < 100, 0.0, amplitude)
        y = truth.simulate(r, dt) + 1e-6 * rng.normal(size=600)
        records.append(Record(r[:, None], y[:, None], dt, ("r",), ("y",)))
    (found,) = fit_actuators(records)
    assert found.actuator.delay == pytest.approx(0.016, abs=4 * 2e-5)
    assert found.actuator.time_constant == pytest.approx(0.1113, rel=1e-3)
