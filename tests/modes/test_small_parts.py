"""Stabilisation, noise memory, poles, and the model's file: each against what is known on paper."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parent))
from recordings import DAMPING, DT, HZ, structure

from tau_dyn.modes import Mode, ModelFile, StateSpace, load_state_space, save_state_space
from tau_dyn.modes.modal import build_stabilisation_diagram, find_resonances, list_poles, list_zeros
from tau_dyn.modes.record import stack_lags
from tau_dyn.modes.residuals import fit_noise_model


def _mode(hz: float, damping: float = 0.02, stderr: float = 0.01) -> Mode:
    return Mode(hz, damping, stderr, 0.1 * damping, np.ones(1), 0.0)


def test_stable_points_are_those_that_stay():
    """A mode that stays is stable, one whose damping jumps keeps its frequency only, one that appears is new."""
    points = build_stabilisation_diagram(
        {2: [_mode(7.4)], 4: [_mode(7.41), _mode(30)], 6: [_mode(7.4), _mode(30.01, 0.1)]}
    )
    kinds = {(p.order, round(p.frequency_hz)): p.kind for p in points}
    assert kinds == {(2, 7): "new", (4, 7): "stable", (4, 30): "new", (6, 7): "stable", (6, 30): "frequency"}


def test_an_uncertain_mode_is_given_room():
    """Two percent of change count as the same where the standard error is one percent, and not where it is tiny."""
    for stderr, kind in ((0.1, "stable"), (0.001, "new")):
        assert (
            build_stabilisation_diagram({2: [_mode(10.0, stderr=stderr)], 4: [_mode(10.2, stderr=stderr)]})[1].kind
            == kind
        )


def test_noise_with_a_memory_is_predicted(rng):
    """Of v_t = 0.9 v_{t-1} + e_t one step is foretold to e, three to 1 + 0.9^2 + 0.9^4; white noise not at all."""
    e = rng.normal(size=(20_000, 1))
    v = lfilter([1], [1, -0.9], e, axis=0)
    model = fit_noise_model([v])
    assert model.lags >= 1
    assert np.var(model.ahead(v, 1)) == pytest.approx(1.0, rel=0.04)
    assert np.var(model.ahead(v, 3)) == pytest.approx(1 + 0.81 + 0.81**2, rel=0.06)
    assert fit_noise_model([e]).lags == 0


def test_noise_models_stay_stable(rng):
    """Even of a pure sine, predictions far ahead do not run away."""
    v = np.sin(0.7 * np.arange(400.0))[:, None] + 1e-3 * rng.normal(size=(400, 1))
    assert np.abs(fit_noise_model([v]).ahead(v, 50)).max() < 3


def test_poles_lie_where_frequency_and_damping_say():
    """Im^2 + Re^2 = (2 pi f)^2 and Re = -zeta 2 pi f; the ellipse follows from the errors of both."""
    plant = structure()
    modes = tuple(Mode(f, z, 0.01, 0.001, np.ones(2), 0.0) for f, z in zip(HZ, DAMPING, strict=True))
    poles = list_poles(plant, modes)
    for pole, f, z in zip(poles, HZ, DAMPING, strict=True):
        w = 2 * np.pi * f
        assert_allclose([abs(pole.s), pole.s.real], [w, -z * w], rtol=1e-9)
        assert pole.covariance is not None
        expected = np.hypot(2 * np.pi * z * 0.01, w * 0.001)
        assert np.sqrt(pole.covariance[0, 0]) == pytest.approx(expected, rel=1e-9)
    assert len(find_resonances(plant)) == 2


def test_transmission_zeros_block_an_input():
    """At its zeros the response loses rank: an accelerometer's two zeros at standstill are among them."""
    A = np.array([[0.9, 0.2], [-0.2, 0.9]])
    B, C, D = np.array([[0.0], [1.0]]), np.array([[1.0, 0.3]]), np.array([[0.5]])
    zeros = list_zeros(StateSpace(A, B, C, D, np.zeros((2, 1)), DT))
    assert len(zeros)
    for s in zeros:
        z = np.exp(s * DT)
        assert abs(C @ np.linalg.solve(z * np.eye(2) - A, B) + D)[0, 0] < 1e-8


def test_a_model_comes_back_from_its_file(tmp_path):
    """A saved model simulates as before; a file that is none, or a broken one, is refused by name."""
    plant = structure()
    path = tmp_path / "m.yaml"
    save_state_space(path, ModelFile(plant, ("a", "b"), ("x", "y"), {"made": "here"}))
    back = load_state_space(path)
    f = np.array([1.0, 7.4, 20.0])
    assert_allclose(back.model.frequency_response(f), plant.frequency_response(f), rtol=1e-12)
    assert back.inputs == ("a", "b") and back.provenance == {"made": "here"}
    path.write_text(path.read_text().replace("outputs: [x, y]", "outputs: [x]"))
    with raises_code("file_format", "1", "4"):
        load_state_space(path)
    path.write_text("a: 1\n")
    with raises_code("file_format"):
        load_state_space(path)


@pytest.mark.parametrize("n", [0, 3, 9, 10, 12])
def test_records_shorter_than_the_lags_give_no_rows(n):
    """Ten lags of n samples are max(n - 10, 0) rows, the latest sample first."""
    rows = stack_lags(np.arange(n)[:, None], 10)
    assert rows.shape == (max(n - 10, 0), 10)
    assert_allclose(rows, np.arange(len(rows))[:, None] + np.arange(9, -1, -1))
