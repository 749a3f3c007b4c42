"""Filters of learning: zero phase, dips, shifts, weights; and case 1 of the thesis."""

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control.iterative import (
    LearningLaw,
    MotorSide,
    Reference,
    TimeShift,
    ZeroPhase,
    analyse_convergence,
    build_convolution,
    build_notch,
    chain_filters,
    compute_pulse_response,
    design_band_stop,
    design_low_pass,
    read_saved_actuators,
    stack_controlled_actuators,
)
from tau_dyn.modes import Actuator

DT = 0.004
PRINTED = ((0.03527, 0.9647), (0.03425, 0.9656), (0.02748, 0.9728))  # (6.11)


def test_a_zero_phase_filter_shifts_nothing() -> None:
    """A symmetric pulse stays symmetric about its own middle, and the response is real and positive."""
    t = np.arange(401) - 200
    pulse = np.exp(-((t / 6.0) ** 2))
    for q in (design_low_pass(10, DT), design_band_stop(6, 9, DT), build_notch(7.4, 2, 0.1, DT)):
        out = q.apply(pulse)
        assert_allclose(out, out[::-1], atol=2e-3 * out.max())
        assert np.argmax(np.abs(out)) == 200
        assert np.all(q.response(np.linspace(0.1, 120, 50)) >= 0)


def test_matrix_is_the_filter_and_symmetric() -> None:
    """(7.11): Qc' Qc applied to a signal is the filter forwards and backwards from rest."""
    q = chain_filters([design_low_pass(10, DT), build_notch(7, 2, 0.2, DT)])
    x = np.random.default_rng(0).standard_normal(60)
    assert_allclose(q.matrix(60) @ x, q.apply(x), atol=1e-13)
    assert_allclose(q.matrix(60), q.matrix(60).T, atol=1e-15)


def test_magnitudes_are_those_asked_for() -> None:
    """Half at a Butterworth cutoff (3 dB twice), the floor in the middle of a dip, 1 far away from it."""
    assert_allclose(design_low_pass(10, DT).response(np.array([10.0])), 0.5, rtol=1e-6)
    assert_allclose(build_notch(7.4, 2.0, 0.05, DT).response(np.array([0.1, 7.4, 100.0])), [1, 0.05, 1], rtol=0.01)
    assert design_band_stop(6, 9, DT).response(np.array([7.36]))[0] < 1e-3


def test_shift_holds_the_last_error() -> None:
    """(7.10) as a matrix, as an operation and transposed."""
    L, e = TimeShift(0.9, 3, DT), np.arange(8.0)
    assert_allclose(L.apply(e), 0.9 * np.array([3, 4, 5, 6, 7, 7, 7, 7]))
    assert_allclose(L.matrix(8) @ e, L.apply(e))
    assert_allclose(L.matrix(8).T @ e, L.transposed(e))


def test_weights_fade_in_and_out() -> None:
    """(7.14): zero, a rising half of a Tukey window, one, the same falling."""
    w = Reference(DT, np.zeros((900, 1)), np.zeros((900, 3)), 300, 600).weights()
    assert np.all(w[:201] == 0) and np.all(w[300:600] == 1) and np.all(w[700:] == 0)
    assert np.all(np.diff(w[200:300]) >= 0)
    assert_allclose(w[200:300], w[600:700][::-1])


def test_case_1_has_the_singular_values_of_the_thesis() -> None:
    """(7.28): 0.90, 0.91, 0.93 from (6.11), gain 0.9, shift 5, second-order Butterworth at 10 Hz."""
    drives = stack_controlled_actuators([Actuator.from_discrete(b, a, 5, DT) for b, a in PRINTED], DT)
    m = Reference(DT, np.zeros((900, 3)), np.zeros((900, 3)), 150, 750)
    found = analyse_convergence(
        LearningLaw(MotorSide(drives), (design_low_pass(10, DT),) * 3, TimeShift(0.9, 5, DT)), m
    )
    assert_allclose(found.singular, (0.90, 0.91, 0.93), atol=0.01)
    assert found.monotone and found.stable


def test_filters_that_are_none_are_refused() -> None:
    """Cutoffs beyond half the rate, unstable filters, dips without depth, different steps in one product."""
    with raises_code("invalid_value", "0", "125"):
        design_low_pass(130, DT)
    with raises_code("unstable", "unstable"):
        ZeroPhase(np.array([[1.0, 0, 0, 1, -2.1, 1.1]]), DT)
    with raises_code("invalid_value", "floor"):
        build_notch(7, 1, 0.0, DT)
    with raises_code("mismatch"):
        chain_filters([design_low_pass(10, DT), design_low_pass(10, 0.002)])


def test_unequal_and_fractional_delays_stand_side_by_side(rng) -> None:
    """The stacked model answers as each drive by itself does: delays of 1.2, 2 and 4.9 samples."""
    drives = [Actuator(1.1, 0.006, x * DT) for x in (1.2, 2.0, 4.9)]
    model, u = stack_controlled_actuators(drives, DT), np.vstack([np.zeros((1, 3)), rng.standard_normal((80, 3))])
    alone = np.column_stack([drive.simulate(u[:, k], DT) for k, drive in enumerate(drives)])
    T = build_convolution(compute_pulse_response(model, len(u)))
    assert_allclose((T @ u.T.ravel()).reshape(3, -1).T, alone, atol=1e-12)


def test_a_time_constant_without_a_standard_error_is_read_back(tmp_path) -> None:
    """A delay that explains a drive leaves a time constant far below a sample, known to no number; its value counts as it is."""
    path = tmp_path / "actuators.yaml"
    row = {"axis": "x", "gain": 1.0, "time_constant": 3e-7, "delay": 0.016, "delay_stderr": 1e-3}
    path.write_text(yaml.safe_dump({"tau_dyn_actuators": 1, "axes": [row | {"time_constant_stderr": float("inf")}]}))
    saved = read_saved_actuators(path)
    assert saved.slowest.time_constant == 3e-7
    assert saved.slowest.delay == pytest.approx(0.016 + 1.96e-3, rel=1e-3)
