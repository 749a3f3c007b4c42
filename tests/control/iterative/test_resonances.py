"""Learning on a drive whose load swings on a lightly damped spring, with and without a model of the resonance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.signal import cont2discrete

from tau_dyn.control.iterative import LearningStep, ResonantDrive, compute_learning_step, read_resonant_drives
from tau_dyn.modes import ModelFile, StateSpace, save_state_space

DT, N = 0.004, 1000
NOISE = 1e-6  # [m]


def build_drive(hz: float, damping: float = 0.03, lag: float = 0.008, delay: int = 2) -> ResonantDrive:
    """Return a drive with a lag [s] and a delay [samples] that carries its load on a spring."""
    w = 2 * np.pi * hz
    A = np.array([[-1 / lag, 0, 0], [0, 0, 1], [w * w, -w * w, -2 * damping * w]])
    B, C, D = np.array([[1 / lag], [0], [0]]), np.array([[0, 1.0, 0]]), np.zeros((1, 1))
    Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, C, D), DT)
    return ResonantDrive(StateSpace(Ad, Bd, Cd, Dd, np.zeros((3, 1)), DT, delay))


def stroke() -> np.ndarray:
    """Return two strokes of 20 and 10 mm, the edges short enough to excite 12 Hz."""
    t = np.arange(N) * DT

    def rise(start: float, time: float) -> np.ndarray:
        x = np.clip((t - start) / time, 0, 1)
        return x**3 * (10 - 15 * x + 6 * x**2)

    return 0.02 * (rise(0.8, 0.15) - rise(1.8, 0.15) + 0.5 * rise(2.4, 0.1) - 0.5 * rise(3.0, 0.1))


def learn(true: ResonantDrive, model: ResonantDrive | None, trials: int) -> LearningStep:
    """Return the learning after a first trial and more with corrections."""
    rng, reference = np.random.default_rng(0), stroke()
    given = None if model is None else [model]
    commands, positions = [], []
    sent = reference
    for _ in range(trials + 1):
        commands.append(sent[:, None])
        positions.append((true.simulate(sent, DT) + NOISE * rng.standard_normal(N))[:, None])
        found = compute_learning_step(("load",), DT, reference[:, None], commands, positions, given)
        sent = reference + found.correction[:, 0]
    return found


@pytest.mark.parametrize("hz", [8.0, 12.0, 20.0])
def test_a_model_of_the_resonance_lets_it_be_learnt(hz) -> None:
    """With frequencies 1 % off, five trials leave 2 % of the error, and each outcome is in its interval."""
    found = learn(build_drive(hz), build_drive(1.01 * hz), 5)
    outcomes = found.drives[0].outcomes
    assert outcomes[-1] < 0.02 * outcomes[0] and found.count_inside() == (5, 5)
    assert found.drives[0].law is not None and found.drives[0].law.shift is None and found.to_rows()[0]["inverts"]


@pytest.mark.parametrize("hz", [8.0, 12.0])
def test_a_resonance_that_no_model_shows_never_grows(hz) -> None:
    """A first-order model misses a resonance of 3 % damping; its residual in the first trial bounds the learning there."""
    outcomes = learn(build_drive(hz), None, 4).drives[0].outcomes
    assert outcomes.max() <= 1.1 * outcomes[0] and outcomes[-1] < outcomes[0]


def test_a_model_that_the_trial_contradicts_is_replaced_with_a_code() -> None:
    """A drive of 20 Hz is not one of 3 Hz: the model misses the first trial, and one fitted to it takes its place."""
    found = learn(build_drive(20.0), build_drive(3.0), 0)
    assert [getattr(w, "code", None) for w in found.warnings if "misses the first trial" in w] == ["model_contradicted"]
    assert not isinstance(found.drives[0].response.model, ResonantDrive)


def test_the_inverse_leaves_the_least_that_the_uncertainty_allows() -> None:
    """At each frequency no other complex L leaves less of `|1 - L G|^2 + |L|^2 s^2`; its matrices are adjoint."""
    found = learn(build_drive(12.0), build_drive(12.1), 1)
    drive = found.drives[0]
    G, s, unit = drive.response.mean, drive.response.deviation, drive.law.gain
    L = drive.learning.values[1:] / unit
    left = np.abs(1 - L * G) ** 2 + np.abs(L) ** 2 * s**2
    for step in (1e-3, -1e-3, 1e-3j, -1e-3j):
        other = L * (1 + step)
        assert np.all(np.abs(1 - other * G) ** 2 + np.abs(other) ** 2 * s**2 >= left - 1e-12)
    assert left.max() < 1
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((2, N))
    assert_allclose(y @ drive.learning.apply(x), x @ drive.learning.transposed(y), rtol=1e-9)
    assert_allclose(drive.learning.matrix(N) @ x, drive.learning.apply(x), atol=1e-9)


def test_a_simulated_drive_is_its_response() -> None:
    """A tone through the drive comes out with the size and phase of its response, once the start has died away."""
    drive, hz = build_drive(12.0), 5.0
    t = np.arange(4000) * DT
    tone = 1.0 + np.sin(2 * np.pi * hz * t)
    tone[0] = 1.0
    late = drive.simulate(tone, DT)[3000:] - drive.gain
    size = 2 * np.mean(late * np.exp(-2j * np.pi * hz * t[3000:])) * 1j
    assert_allclose(size, drive.response(np.array([hz]), DT)[0], rtol=2e-2)


def test_models_that_are_no_drives_are_refused(tmp_path) -> None:
    """Other columns, another step, an unstable model and one without a static gain are refused in a sentence each."""
    good, path = build_drive(12.0).model, tmp_path / "m.yaml"

    def write(model: StateSpace, names: tuple[str, ...] = ("q_ref_a",)) -> None:
        save_state_space(path, ModelFile(model, names, ("q_a",), {}))

    write(good)
    assert len(read_resonant_drives(path, ("a",), DT)) == 1
    for names, dt, code in ((("a", "b"), DT, "mismatch"), (("a",), 0.001, "mismatch")):
        with raises_code(code):
            read_resonant_drives(path, names, dt)
    for model, code in (
        (StateSpace(1.2 * good.A, good.B, good.C, good.D, good.K, DT), "unstable"),
        (StateSpace(good.A, good.B, 1e-3 * good.C, good.D, good.K, DT), "mismatch"),
    ):
        write(model)
        with raises_code(code):
            read_resonant_drives(path, ("a",), DT)
