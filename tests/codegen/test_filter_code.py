"""Observers and learning filters in C: what Python computes, sample by sample and trial by trial."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.codegen import write_learning_source, write_observer_source
from tau_dyn.codegen.filters import pad_to_third_order
from tau_dyn.control import (
    ComplementaryToolObserver,
    KalmanToolObserver,
    LearningLaw,
    MotorSide,
    NormOptimalLaw,
    TimeShift,
    build_notch,
    chain_filters,
    design_low_pass,
)
from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace

DT, N = 0.004, 400


def springy(direct: float, delay: int) -> StateSpace:
    """Return a tool that sways at 11 and 14 Hz behind the actuators, two axes."""
    A, C = np.zeros((4, 4)), np.zeros((2, 4))
    B = np.zeros((4, 2))
    for k, f in enumerate((11.0, 14.0)):
        w = 2 * np.pi * f * DT
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = 0.98 * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
        B[2 * k, k], C[k, 2 * k] = 0.05, 1.0
    C += 0.1 * np.roll(C, 1, axis=1)
    D = direct * np.eye(2)
    gain = C @ np.linalg.solve(np.eye(4) - A, B) + D
    return StateSpace(A, B @ np.linalg.inv(gain), C, D, np.zeros((4, 2)), DT, delay)


def trial(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return places computed from actuators and accelerations (N, 2) that fit to nothing in particular."""
    return np.array([0.3, -1.2]) + 0.01 * np.cumsum(rng.standard_normal((N, 2)), axis=0), rng.standard_normal((N, 2))


OBSERVERS = {
    "causal": lambda: ComplementaryToolObserver((4.5, 2.63), DT, causal=True),
    "kalman": lambda: KalmanToolObserver(springy(0.0, 0), 1e-10, 0.01),
    "kalman, direct part": lambda: KalmanToolObserver(springy(0.2, 0), 1e-6 * np.eye(10), np.diag([0.01, 0.02])),
    "kalman, delayed": lambda: KalmanToolObserver(springy(0.0, 2), 1e-6 * np.eye(12), 0.01),
    "kalman, as printed": lambda: KalmanToolObserver(springy(0.0, 0), 1e-10, 0.01, aligned=False, predict=True),
}


@pytest.mark.parametrize("kind", OBSERVERS)
def test_an_observer_steps_as_in_python(kind, compiled, rng) -> None:
    """One call a sample gives the estimate of the whole trial; a sample that is no number changes nothing."""
    observer = OBSERVERS[kind]()
    code = compiled(write_observer_source(observer, "tool"), "tool")
    kinematic, acceleration = trial(rng)
    state, z = np.full(200, 7.0), np.zeros((N, 2))
    code("start", state, kinematic[0].copy())
    for k in range(N):
        if k == 30:
            before = state.copy()
            assert code("step", state, kinematic[k].copy(), np.array([np.nan, 0.0]), z[k]) == 1
            np.testing.assert_array_equal(state, before)
        assert code("step", state, kinematic[k].copy(), acceleration[k].copy(), z[k]) == 0
    expected = observer.estimate(kinematic, acceleration)
    assert np.abs(z - expected).max() < 1e-12 * max(1.0, np.abs(expected).max())


def test_a_filters_table_begins_with_one() -> None:
    """A filter is the same whatever its leading coefficient; C divides by none."""
    row = pad_to_third_order(np.array([2.0, 1.0]), np.array([4.0, 1.0, 2.0]))
    np.testing.assert_allclose(row, [0.5, 0.25, 0, 0, 1, 0.25, 0.5, 0])


def test_the_zero_phase_observer_takes_a_trial(compiled, rng) -> None:
    """Forwards and backwards over the trial and its tail; the answer may replace the places given."""
    observer = ComplementaryToolObserver((4.5, 2.63), DT)
    code = compiled(write_observer_source(observer, "tool"), "tool")
    kinematic, acceleration = trial(rng)
    z, work = kinematic.copy(), np.zeros(2 * N)
    assert code("trial", N, z, acceleration, z, work) == 0
    np.testing.assert_allclose(z, observer.estimate(kinematic, acceleration), rtol=0, atol=1e-11)
    assert code("trial", 1, z, acceleration, z, work) == 1


def law() -> LearningLaw:
    """Return filters for two channels, one with a dip."""
    side = MotorSide(springy(0.0, 1))
    Q = design_low_pass(10, DT), chain_filters([design_low_pass(30, DT), build_notch(11.0, 2.0, 0.1, DT)])
    return LearningLaw(side, Q, TimeShift(0.9, 5, DT))


class Weights:
    """A motion of which the law asks its length and weights alone."""

    n = N

    def weights(self) -> np.ndarray:
        """Return a fading in and out."""
        return np.sin(np.linspace(0, np.pi, N))


def test_a_correction_is_updated_as_in_python(compiled, rng) -> None:
    """`Q_w Q_z (u + L e)`, each filter alone, and a correction beyond its limit that is not sent."""
    code = compiled(write_learning_source(law(), (0.5, 1.5), "ilc"), "ilc")
    u, e = 1e-2 * rng.standard_normal((2, N, 2))
    expected = law().update(Weights(), u, e)  # type: ignore[arg-type]
    found, work = u.copy(), np.zeros((N, 2))
    assert code("update", N, Weights().weights(), e, found, work) == 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    for channel, q in enumerate(law().forgetting):
        x = u[:, channel].copy()
        code("q", channel, N, x)
        np.testing.assert_allclose(x, q.apply(u[:, channel]), rtol=0, atol=1e-12)
    shifted = np.zeros((N, 2))
    code("l", N, e, shifted)
    np.testing.assert_array_equal(shifted, law().learning.apply(e))
    kept = found.copy()
    assert code("update", N, None, 1e3 * e, found, work) == 2
    assert code("update", N, None, np.full_like(e, np.nan), found, work) == 1
    np.testing.assert_array_equal(found, kept)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: write_learning_source(law(), 0.0), "must be a positive number"),
        (lambda: write_learning_source(law(), (1.0, 1.0, 1.0)), "or 2 of them"),
        (lambda: write_learning_source(NormOptimalLaw(law().side), 1.0), "NormOptimalLaw is no low-pass and shift"),  # type: ignore[arg-type]
        (lambda: write_learning_source(law(), 1.0, "a-b"), "cannot name a function in C"),
        (lambda: write_observer_source(OBSERVERS["causal"](), "double"), "cannot name a function in C"),
    ],
)
def test_what_cannot_be_written_is_refused(make, said) -> None:
    """A sentence, and no code."""
    with pytest.raises(InputError, match=said):
        make()


@pytest.mark.parametrize("kind", ["causal", "kalman"])
def test_a_spoilt_state_gives_no_place(kind, compiled) -> None:
    """Where the state was begun with a number that is none, each step says so, and z stays."""
    code = compiled(write_observer_source(OBSERVERS[kind](), "tool"), "tool")
    state, z = np.zeros(200), np.full(2, 7.0)
    code("start", state, np.array([np.nan, 0.0]))
    for _ in range(3):
        assert code("step", state, np.zeros(2), np.zeros(2), z) == 1 and np.all(z == 7)


def test_filters_of_learning_refuse_what_is_no_number(compiled) -> None:
    """Q and L alone have statuses: a channel that is not there, a number that is none or far too large."""
    code = compiled(write_learning_source(law(), 1.0, "ilc"), "ilc")
    x, out = np.array([0.1, np.inf]), np.full(4, 7.0)
    assert code("q", 0, 2, x) == 1 and code("q", 2, 1, x) == 1 and x[0] == 0.1
    assert code("l", 2, np.array([0.0, 1e200, 0.0, 0.0]), out) == 1 and np.all(out == 7)
