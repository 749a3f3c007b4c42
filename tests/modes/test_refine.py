"""Refinement: exact gradients, a minimum reached from poor starts, and honest standard errors."""

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code
from scipy.signal import lfilter

from tau_dyn.modes import Record, StateSpace, refine
from tau_dyn.modes.fit_point import build_columns, compute_derivative_maps, evaluate
from tau_dyn.modes.hankel import compute_spectrum, fit_autoregression
from tau_dyn.modes.modal import compute_frequency_and_damping, find_resonances
from tau_dyn.modes.modal_descent import balance_model
from tau_dyn.modes.modal_form import (
    build_layout,
    build_modal_form,
    build_modal_form_with_coordinates,
    flatten_form,
    step_form,
)
from tau_dyn.modes.refinement import build_innovation_model, build_predictor
from tau_dyn.modes.state_space import simulate, simulate_states

DT = 0.01


def plant() -> StateSpace:
    """A resonance at 9 Hz (2 %), one at 20 Hz (5 %) and a real pole; two inputs, two outputs."""
    rng = np.random.default_rng(0)
    poles = [np.exp(2 * np.pi * f * DT * (-z + 1j * np.sqrt(1 - z**2))) for f, z in ((9.0, 0.02), (20.0, 0.05))]
    A = np.zeros((5, 5))
    for k, pole in enumerate(poles):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
    A[4, 4] = 0.8
    T = rng.normal(size=(5, 5)) + 3 * np.eye(5)
    plain = StateSpace(A, rng.normal(size=(5, 2)), rng.normal(size=(2, 5)), np.zeros((2, 2)), np.zeros((5, 2)), DT)
    return plain.in_coordinates(T)


def record_of(model: StateSpace, n: int, seed: int, noise: float, colour: tuple[float, ...] = (1.0,)) -> Record:
    """White inputs; output noise with an autoregressive colour."""
    rng = np.random.default_rng(seed)
    empty = Record(rng.normal(size=(n, 2)), np.zeros((n, 2)), DT, ("a", "b"), ("c", "d"))
    y = simulate(model, empty, np.zeros(model.order))
    v = lfilter([1.0], colour, rng.normal(size=(n + 200, 2)), axis=0)[200:]
    return replace(empty, y=y + noise * y.std(axis=0) * v / v.std(axis=0))


def test_modal_form_is_the_same_model():
    """Poles, response and the states' coordinates survive the change of form and its way back."""
    model = plant()
    form, W = build_modal_form_with_coordinates(model)
    back = form.state_space()
    f = np.linspace(0.5, 45, 20)
    assert np.allclose(back.frequency_response(f), model.frequency_response(f), rtol=1e-9)
    assert np.allclose(W @ model.A, back.A @ W) and np.allclose(back.C @ W, model.C)
    assert np.allclose(np.abs(form.c).max(axis=0), 1)
    again = balance_model(model)
    assert np.allclose(again.frequency_response(f), model.frequency_response(f), rtol=1e-8)


def test_gradient_is_the_difference_quotient():
    """Every derivative column equals the change of the simulated output for a small change of its parameter."""
    form = build_modal_form(plant())
    record = record_of(plant(), 300, 1, 0.0)
    x0 = np.random.default_rng(2).normal(size=len(form.poles)) + 0.3j * form.oscillates
    layout, h = build_layout(form), 1e-6

    def output(candidate, start):
        return np.vstack([c.predicted for c in build_columns(candidate, start, record, chunk=64)])

    real = np.vstack([c.real for c in build_columns(form, x0, record, chunk=64)])
    maps = compute_derivative_maps(form, x0)
    assert np.abs(flatten_form(step_form(form, np.zeros(layout.size))) - flatten_form(form)).max() == 0
    for index in range(layout.size + 2 * layout.n_modes):
        step = np.zeros(layout.size + 2 * layout.n_modes)
        step[index] = h
        dx = step[layout.size :].reshape(-1, 2) @ [1, 1j]
        ahead = output(step_form(form, step[: layout.size]), x0 + dx)
        behind = output(step_form(form, -step[: layout.size]), x0 - dx)
        expected = (ahead - behind) / (2 * h)
        found = np.zeros_like(expected)
        for a in np.flatnonzero(maps.shared == index):
            found += real[:, maps.re[a], None] * maps.real[:, a] + real[:, maps.im[a], None] * maps.imaginary[:, a]
        for o, b in np.argwhere(maps.own == index):
            found[:, o] += real @ maps.own_map[:, b]
        assert np.allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max() + 1e-9)


def test_prediction_form_and_back():
    """The one-step predictor of an innovation form, read backwards, is the innovation form."""
    model = replace(plant(), K=0.1 * np.random.default_rng(3).normal(size=(5, 2)), D=np.eye(2))
    back = build_innovation_model(build_modal_form(build_predictor(model)))
    f = np.linspace(0.5, 45, 10)
    assert np.allclose(back.frequency_response(f), model.frequency_response(f), rtol=1e-8)
    assert np.allclose(sorted(np.abs(back.poles())), sorted(np.abs(model.poles())))


def test_a_poor_start_reaches_the_same_minimum():
    """From poles 5 % off, and from a start that took the slower pair for two real poles, to the same model."""
    record = record_of(plant(), 3000, 4, 0.05)
    good = refine(plant(), [record])
    form = build_modal_form(plant())
    off = step_form(
        form, np.concatenate([0.02 * np.r_[pole.real, pole.imag, np.zeros(8)] for pole in -form.poles] + [np.zeros(4)])
    )
    two_real = StateSpace(
        np.diag([0.7, 0.6, 0.8, 0.75, 0.65]), np.ones((5, 2)), np.ones((2, 5)), np.zeros((2, 2)), np.zeros((5, 2)), DT
    )
    for start in (off.state_space(), two_real):
        found = refine(start, [record], maximum_rounds=80)
        assert found.model.spectral_radius() < 1
        assert found.loss == pytest.approx(good.loss, abs=1e-4)


@pytest.mark.parametrize("colour", [(1.0,), (1.0, -1.6, 0.9)])
def test_standard_errors_are_the_scatter_also_under_coloured_noise(colour):
    """Over 40 logs the spread of frequency and damping is what each log says of itself."""
    found = []
    for seed in range(40):
        modes = refine(plant(), [record_of(plant(), 1500, 100 + seed, 0.2, colour)]).modes
        found.append([(m.frequency_hz, m.damping_ratio, m.frequency_stderr, m.damping_stderr) for m in modes])
    values = np.array(found)
    scatter, said = values[..., :2].std(axis=0), np.sqrt((values[..., 2:] ** 2).mean(axis=0))
    assert np.all(scatter / said > 0.7) and np.all(scatter / said < 1.35)
    truth = np.array([(m.frequency_hz, m.damping_ratio) for m in find_resonances(plant())])
    inside = np.abs(values[..., :2] - truth) < 1.96 * values[..., 2:]
    assert 0.88 <= inside.mean() <= 0.99


@pytest.mark.parametrize("kind", ["output_error", "prediction_error"])
def test_response_bands_hold_the_truth(kind):
    """The response's covariance, also through the predictor of the innovation form, matches its errors."""
    f = np.array([3.0, 9.0, 14.0, 20.0, 30.0])
    ratios = []
    for seed in range(6):
        record = record_of(plant(), 2000, 200 + seed, 0.1)
        start = (
            plant()
            if kind == "output_error"
            else replace(plant(), K=np.linalg.lstsq(plant().C, np.eye(2), rcond=None)[0] * 0.2)
        )
        refined = refine(start, [record], kind=kind)
        error = refined.model.frequency_response(f) - plant().frequency_response(f)
        spread = refined.response_covariance(f)
        ratios.append(error.real**2 / spread[..., 0, 0])
        ratios.append(error.imag**2 / spread[..., 1, 1])
    assert 0.5 < np.mean(ratios) < 1.8


def test_feedback_is_no_obstacle_to_prediction_errors():
    """A loop around a plant that unmeasured forces shake too: prediction errors hold the true damping within their stderr."""
    model = replace(plant(), K=np.zeros((5, 2)))
    rng = np.random.default_rng(6)
    n = 20_000
    gain = 0.03 * np.eye(2)
    A = np.block([[model.A, -model.B @ gain], [model.C, np.zeros((2, 2))]])
    r, w, e = rng.normal(size=(n, 2)), 0.2 * rng.normal(size=(n, 5)), 0.01 * rng.normal(size=(n, 2))
    drive = np.hstack([r @ model.B.T + w, e])
    x = simulate_states(A, drive, np.zeros(7))
    assert np.abs(np.linalg.eigvals(A)).max() < 1
    record = Record(r - x[:, 5:] @ gain.T, x[:, :5] @ model.C.T + e, DT, ("a", "b"), ("c", "d"))
    start = replace(model, K=np.linalg.lstsq(model.C, np.eye(2), rcond=None)[0] * 0.5)
    refined = refine(start, [record], kind="prediction_error")
    truth = {round(m.frequency_hz): m.damping_ratio for m in find_resonances(model)}
    for mode in refined.modes:
        assert abs(mode.damping_ratio - truth[round(mode.frequency_hz)]) < 4 * mode.damping_stderr
        assert mode.damping_stderr < 0.1 * mode.damping_ratio


def test_autoregression_takes_white_for_white_and_finds_colour():
    """Bayes' order is zero for white noise; for coloured noise the spectrum has the right height."""
    rng = np.random.default_rng(7)
    white = rng.normal(size=(4000, 2))
    assert len(fit_autoregression([white])[0]) == 0
    coloured = lfilter([1.0], [1.0, -0.9], white, axis=0)
    density = compute_spectrum(*fit_autoregression([coloured]), 64)
    assert density[0, 0, 0].real == pytest.approx(100, rel=0.25)
    assert density[32, 1, 1].real == pytest.approx(1 / 1.9**2, rel=0.1)


def test_frequency_and_damping_of_a_pole():
    """A sampled pole of 10 Hz and 3 % is read as such."""
    s = 2 * np.pi * 10 * (-0.03 + 1j * np.sqrt(1 - 0.03**2))
    assert np.allclose(compute_frequency_and_damping(np.exp(s * 0.004), 0.004), [10, 0.03])


def test_theta_and_model_agree():
    """A model rebuilt from its own parameters is the same; a step in theta moves it."""
    refined = refine(plant(), [record_of(plant(), 1000, 8, 0.1)])
    f = np.array([5.0, 9.0])
    assert np.allclose(refined.model_at(refined.theta).frequency_response(f), refined.model.frequency_response(f))
    moved = refined.model_at(refined.theta + 1e-3).frequency_response(f)
    assert not np.allclose(moved, refined.model.frequency_response(f), rtol=1e-6)
    assert refined.covariance.shape == (refined.theta.size,) * 2


def test_unknown_kind_is_refused():
    """There are two refinements, and a misspelt one says so."""
    with raises_code("invalid_value", "prediction_error"):
        refine(plant(), [record_of(plant(), 200, 9, 0.1)], kind="other")


def test_records_side_by_side_are_those_one_by_one():
    """Records of like length are walked through together; each one's products and the loss are those of it alone."""
    form = build_modal_form(plant())
    records = [record_of(plant(), n, n, 0.1) for n in (300, 290, 40, 260)]
    rng = np.random.default_rng(4)
    x0 = rng.normal(size=(4, len(form.poles))) * [1.0, 1j, 1.0][: len(form.poles)]
    together = evaluate(form, x0, records)
    alone = [evaluate(form, x0[r : r + 1], [record]) for r, record in enumerate(records)]
    assert np.allclose(together.squares, sum(point.squares for point in alone), rtol=1e-10)
    for r, point in enumerate(alone):
        assert np.allclose(together.grams[r], point.grams[0], rtol=1e-9, atol=1e-9 * np.abs(point.grams[0]).max())
        assert np.allclose(together.cross[r], point.cross[0], rtol=1e-9, atol=1e-9 * np.abs(point.cross[0]).max())
