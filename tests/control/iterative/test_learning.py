"""Learning takes away what repeats, and only that; what would not converge never moves the robot."""

import sys
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control.iterative import (
    LearningLaw,
    MotorSide,
    NormOptimalLaw,
    TimeShift,
    ToolSide,
    analyse_convergence,
    build_iteration_operator,
    design_low_pass,
    design_robust_filter,
    learn,
)
from tau_dyn.control.observers import ComplementaryToolObserver
from tau_dyn.modes import StateSpace

sys.path.insert(0, str(Path(__file__).parent))

from plants import DT, Carts, actuators, motion  # noqa: E402


def law(cutoff: float = 10.0, gain: float = 0.9, shift: int = 5) -> LearningLaw:
    return LearningLaw(MotorSide(actuators()), (design_low_pass(cutoff, DT),) * 2, TimeShift(gain, shift, DT))


def resonant() -> StateSpace:
    """Two tool axes, each with a resonance at 9 Hz behind a delay of four samples."""
    w, zeta = 2 * np.pi * 9 * DT, 0.03
    r = np.exp(-zeta * w)
    A1 = r * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    b = np.linalg.solve(np.array([[1.0, 0.0], A1[0]]), np.array([0.02, 0.06]))
    gain = float((np.array([[1.0, 0.0]]) @ np.linalg.solve(np.eye(2) - A1, b))[0])
    eye = np.eye(2)
    A, B, C = np.kron(eye, A1), np.kron(eye, b[:, None]) / gain, np.kron(eye, [[1.0, 0.0]])
    return StateSpace(A, B, C, np.zeros((2, 2)), np.zeros((4, 2)), DT, 4)


def test_a_repeating_error_is_learnt_away() -> None:
    """Lag, delay and sway repeat: after ten trials a hundredth of the error is left, and every trial brings it closer."""
    done = learn(Carts(), motion(), law(), 10)
    relative = done.relative()
    assert np.all(relative[-1] < 3)
    # the correction comes closer to its limit in every trial, (7.16)
    apart = np.linalg.norm(done.corrections[:-1] - done.corrections[-1], axis=(1, 2))
    assert np.all(np.diff(apart) < 0)


def test_what_does_not_repeat_stays() -> None:
    """With noise from trial to trial the error ends at the noise, amplified by learning it, not below."""
    noise = 2e-5
    done = learn(Carts(noise=noise), motion(), law(), 12)
    left = done.rms()[6:].mean(axis=0)
    exact = learn(Carts(), motion(), law(), 12).rms()[-1]
    assert np.all(left > 0.95 * noise)
    assert np.all(left < np.hypot(1.5 * noise, 2 * exact))


def test_outside_the_weighted_part_nothing_is_corrected() -> None:
    """Before the lead-in and after the lead-out the reference goes to the robot as it is (7.14)."""
    m = motion()
    done = learn(Carts(), m, law(), 3)
    assert np.all(done.corrections[:, : m.first - m.lead] == 0)
    assert np.all(done.corrections[:, m.last + m.lead :] == 0)
    assert np.abs(done.corrections[-1][m.full]).max() > 1e-4


def test_operator_is_the_printed_matrix() -> None:
    """Q (I - L T) by filters and Fourier transforms equals the product of the matrices (7.9) to (7.14)."""
    m, one = motion(), law()
    Q, L = one.matrices(m)
    T = one.side.operator(m.n) @ np.eye(2 * m.n)
    H = Q @ (np.eye(m.n) - L @ T[: m.n, : m.n])
    on = m.weights() > 0
    ours = build_iteration_operator(one, m) @ np.eye(2 * m.n)
    assert_allclose(ours[: m.n, : m.n][:, on], H[:, on], atol=1e-12)
    found = analyse_convergence(one, m)
    assert_allclose(found.singular[0], np.linalg.svd(H[:, on], compute_uv=False)[0], rtol=1e-5)


def test_an_unstable_law_is_refused_at_its_frequency_and_nothing_moves() -> None:
    """A tool with a resonance at 9 Hz, learnt with a low-pass at 12 Hz: the refusal names 9 Hz."""
    plant, model = Carts(), resonant()
    side = ToolSide(model, lambda tool: tool[:, :2])
    with raises_code("unstable", "9"):
        learn(plant, motion(), LearningLaw(side, (design_low_pass(12, DT),) * 2, TimeShift(0.9, 5, DT)), 3)
    assert plant.runs == 0


def test_refused_law_would_have_grown() -> None:
    """The refusal is right: with the sign of the gain turned, corrections do grow from trial to trial."""
    m = motion()
    wrong = law(gain=-0.9)
    with raises_code("unstable"):
        learn(Carts(), m, wrong, 3)
    u, sizes = np.zeros_like(m.q), []
    for k in range(6):
        u = wrong.update(m, u, m.q - Carts().run(m.q + u, k).q)
        sizes.append(np.linalg.norm(u))
    assert np.all(np.diff(sizes) > 0)


def test_dips_let_a_resonance_be_passed() -> None:
    """Q from `design_robust_filter` forgets at 9 Hz, learns at 2 Hz, and the law converges with the growth that was asked for."""
    side, L = ToolSide(resonant(), lambda tool: tool[:, :2]), TimeShift(0.9, 5, DT)
    Q = design_robust_filter(side, L, 30.0, growth=0.8)
    low, at, above = Q.response(np.array([2.0, 9.0, 22.0]))
    assert low > 0.9 and at < 0.2 and above > 2 * at
    found = analyse_convergence(LearningLaw(side, (Q, Q), L), motion())
    assert found.monotone and max(found.singular) < 0.85


def test_norm_optimal_is_monotone_and_learns() -> None:
    """Its H = change (S + effort + change)^-1: no singular value above change / (effort + change), and the error goes."""
    optimal = NormOptimalLaw(MotorSide(actuators()), effort=1e-4, change=0.05)
    done = learn(Carts(), motion(), optimal, 8)
    H = build_iteration_operator(optimal, motion()) @ np.eye(800)
    assert np.linalg.norm(H, 2) <= done.convergence.singular[0] + 1e-9
    assert_allclose(done.convergence.singular[0], 0.05 / 0.0501)
    assert np.all(done.relative()[-1] < 3)


def test_norm_optimal_solves_each_motion_for_itself() -> None:
    """A law used on one motion after another never answers with the matrices of an earlier one."""
    optimal = NormOptimalLaw(MotorSide(actuators()), effort=1e-4, change=0.05)

    def solved(first: int) -> tuple[np.ndarray, np.ndarray]:
        once = motion(first)  # gone at the end; the next one may be made at its address
        fresh = NormOptimalLaw(MotorSide(actuators()), effort=1e-4, change=0.05)
        return optimal.operators(once)[0] @ np.ones(800), fresh.operators(once)[0] @ np.ones(800)

    for first in (60, 90, 120, 150, 60):
        assert_allclose(*solved(first))


def test_observed_side_with_exact_models_is_the_measured_side() -> None:
    """Computed and accelerated tool from one model: complementary filters add up to 1, so F_y T_uy is T_uy."""
    model, inverse = resonant(), lambda tool: tool[:, :2]
    observer = ComplementaryToolObserver((4.0, 4.0), DT)
    seen = ToolSide(model, inverse, observer=observer, kinematic_model=model)
    f = np.array([0.5, 3.0, 9.0, 15.0])
    assert_allclose(seen.response(f), ToolSide(model, inverse).response(f), rtol=0.05, atol=1e-3)
    T = ToolSide(model, inverse).operator(300) @ np.eye(600)[:, :1]
    assert_allclose((seen.operator(300) @ np.eye(600)[:, :1])[:200], T[:200], atol=0.03 * np.abs(T).max())


def test_unsafe_settings_are_refused() -> None:
    """Other sampling steps, too large corrections, a part that does not fit, an observer without its model."""
    with raises_code("mismatch", "2"):
        learn(Carts(dt=0.002), motion(), law(), 2)
    with raises_code("mismatch"):
        LearningLaw(MotorSide(actuators()), (design_low_pass(10, 0.002),) * 2, TimeShift(0.9, 5, DT))
    with raises_code("invalid_value", "1e-05"):
        learn(Carts(), motion(), law(), 2, limit=1e-5)
    with raises_code("mismatch"):
        motion(first=20)
    with raises_code("mismatch"):
        ToolSide(resonant(), lambda tool: tool, observer=ComplementaryToolObserver((4.0, 4.0), DT))
