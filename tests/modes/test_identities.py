"""Numbers beside a modal model against their definitions: standard errors by differences, predictors, criteria, freedoms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.modes import Mode, StateSpace
from tau_dyn.modes.feedback_tests import _answers
from tau_dyn.modes.modal import compute_frequency_and_damping, find_resonances, widen_modes
from tau_dyn.modes.modal_form import build_layout, build_modal_form, free_numbers
from tau_dyn.modes.record import Record
from tau_dyn.modes.refinement import build_predictor, propagate_covariance
from tau_dyn.modes.residuals import check_independence, compute_aic_bic
from tau_dyn.modes.state_space import simulate

DT = 0.002


def build_model(rng: np.random.Generator) -> StateSpace:
    """Return two resonances at 9 and 31 Hz with an input, two outputs, a direct answer and a noise gain."""
    A = np.zeros((4, 4))
    for k, (hz, damping) in enumerate(((9.0, 0.03), (31.0, 0.02))):
        w = 2 * np.pi * hz
        pole = np.exp((-damping + 1j * np.sqrt(1 - damping**2)) * w * DT)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
    B, C, D = rng.normal(size=(4, 1)), rng.normal(size=(2, 4)), rng.normal(size=(2, 1))
    return StateSpace(A, B, C, D, 0.05 * rng.normal(size=(4, 2)), DT, 0)


def test_standard_errors_of_modes_follow_from_their_poles(rng):
    """Derivatives of frequency and damping by central differences of the pole turn its covariance into theirs."""
    form = build_modal_form(build_model(rng))
    size, where = build_layout(form).size, build_layout(form).pole
    root = 1e-4 * rng.normal(size=(size, size))
    covariance = root @ root.T
    for k, mode in zip(
        np.argsort(np.abs(np.angle(form.poles))), find_resonances(form.state_space(), covariance), strict=True
    ):
        pole, h = form.poles[k], 1e-6
        slope = np.column_stack(
            [
                (compute_frequency_and_damping(pole + s, DT) - compute_frequency_and_damping(pole - s, DT)) / (2 * h)
                for s in (h, 1j * h)
            ]
        )
        both = slope @ covariance[np.ix_(where[k], where[k])] @ slope.T
        assert_allclose([mode.frequency_stderr, mode.damping_stderr], np.sqrt(np.diag(both)), rtol=1e-5)
        assert_allclose(mode.correlation, both[0, 1] / np.sqrt(both[0, 0] * both[1, 1]), atol=1e-5)


def test_frequency_and_damping_are_those_of_the_undamped_swing():
    """A pole at `-zeta w + j w sqrt(1 - zeta^2)` has the frequency w and the damping zeta, strong damping included."""
    for zeta in (0.02, 0.6):
        w = 2 * np.pi * 12.0
        pole = np.exp((-zeta + 1j * np.sqrt(1 - zeta**2)) * w * DT)
        assert_allclose(compute_frequency_and_damping(pole, DT), [12.0, zeta], rtol=1e-12)


@pytest.mark.parametrize(("apart", "added"), [(0.04, 0.0), (0.3, 0.09 - 4 * (0.05**2 - 0.03**2))])
def test_models_that_differ_by_more_than_chance_widen_an_interval(apart, added):
    """Hausman: of a difference d what lies beyond two standard deviations of it, `d^2 - 4 |s1^2 - s0^2|`, is model error."""
    mode, other = (Mode(f, 0.02, s, 1e-4, np.ones(1), 0.0) for f, s in ((10.0, 0.03), (10.0 + apart, 0.05)))
    (wide,) = widen_modes([mode], [([mode], [other])])
    assert_allclose(wide.frequency_stderr**2, 0.03**2 + added, rtol=1e-9)


def test_a_predictor_leaves_the_innovations(rng):
    """Outputs made by `x+ = A x + B u + K e, y = C x + D u + e`: what the predictor misses of them is e."""
    model, n = build_model(rng), 400
    u, e, x = rng.normal(size=(n, 1)), 0.1 * rng.normal(size=(n, 2)), np.zeros(4)
    y = np.zeros((n, 2))
    for k in range(n):
        y[k] = model.C @ x + model.D @ u[k] + e[k]
        x = model.A @ x + model.B @ u[k] + model.K @ e[k]
    record = Record(np.hstack([u, y]), y, DT, ("u", "y1", "y2"), ("y1", "y2"))
    assert_allclose(y - simulate(build_predictor(model), record, np.zeros(4)), e, atol=1e-9)


def test_a_covariance_that_is_carried_nowhere_stays(rng):
    """Through the change that is none, free numbers keep their covariance."""
    form = build_modal_form(build_model(rng))
    direct = np.ones((2, 1), bool)
    free = np.flatnonzero(free_numbers(form, direct))
    root = 1e-3 * rng.normal(size=(len(free), len(free)))
    carried = propagate_covariance(form, root @ root.T, direct, lambda form: build_modal_form(form.state_space()), form)
    assert_allclose(carried[np.ix_(free, free)], root @ root.T, rtol=1e-4, atol=1e-9)


def test_criteria_are_those_of_akaike_and_schwarz():
    """`-2 log L + 2 k` and `-2 log L + k log n`."""
    assert_allclose(compute_aic_bic(-3.0, 500, 7), [-1500 + 14, -1500 + 7 * np.log(500)])


def test_freedoms_that_a_fit_used_make_its_residual_less_believable(rng):
    """The same correlation with the input is rarer by chance where a fit has taken freedoms of it."""
    e, u = ([rng.normal(size=(2000, 1))] for _ in range(2))
    free, fitted = (check_independence(e, u, ["y"], ["u"], lags=20, used=k)[0].p_value for k in (0, 12))
    assert 0.01 < fitted < 0.9 * free
    p = [
        check_independence([rng.normal(size=(800, 1))], [rng.normal(size=(800, 1))], ["y"], ["u"], lags=20)[0].p_value
        for _ in range(120)
    ]
    assert 0.35 < np.mean(p) < 0.65 and np.mean(np.array(p) < 0.1) < 0.25


def test_a_late_model_turns_the_phase_back(rng):
    """Three samples late the response is `z^-3` times the prompt one, at every frequency."""
    model, f = build_model(rng), np.array([1.0, 9.0, 40.0])
    z = np.exp(2j * np.pi * f * DT)[:, None, None]
    assert_allclose(replace(model, delay=3).frequency_response(f), z**-3 * model.frequency_response(f), rtol=1e-12)


def test_chance_alone_foretells_no_input(rng):
    """White inputs that nothing feeds back: of their variance past innovations foretell nothing, in the median of 40."""
    shares = []
    for _ in range(40):
        record = Record(rng.normal(size=(600, 1)), rng.normal(size=(600, 1)), DT, ("u",), ("y",))
        shares.append(_answers([record], [rng.normal(size=(570, 1))], 20)[0][1])
    assert np.median(shares) < 0.01
