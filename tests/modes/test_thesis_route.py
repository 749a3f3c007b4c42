"""The thesis' unconstrained route, and what its printed matrices say."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from structures import DT, chain, refined, relative_error
from thesis_6_3_parts.matrices import PRINTED, judge_character, solve_unconstrained

from tau_dyn.modes.mechanical import fit_mechanical
from tau_dyn.modes.mechanical.structure import OUTPUTS


def test_the_printed_stiffness_is_not_positive_definite() -> None:
    """The thesis calls K positive definite and prints its eigenvalues: -1588 +- 2500i."""
    found = judge_character(PRINTED)
    assert_allclose(np.sort_complex(found.stiffness_eigenvalues), [-1588.3 - 2499.5j, -1588.3 + 2499.5j], rtol=1e-4)
    assert found.lowest[2] < 0 and not found.physical


def test_the_printed_resonances_leave_damping_out() -> None:
    """14 and 103 Hz are sqrt|lambda| of M and K alone, and these roots grow: lambda is positive."""
    found = judge_character(PRINTED)
    assert_allclose(found.undamped_hz, [13.83, 103.34], rtol=1e-3)
    assert np.all(found.undamped_roots.real > 0)
    assert_allclose(found.undamped_roots.imag, 0, atol=1e-6)


def test_with_the_printed_damping_two_poles_are_unstable() -> None:
    """D has a positive trace and a negative determinant; with it the four poles are real, two of them growing."""
    found = judge_character(PRINTED)
    assert np.trace(PRINTED.D) > 0 > np.linalg.det(PRINTED.D)
    assert found.n_unstable == 2
    assert_allclose(np.sort(found.poles.real), [-660.5, -72.3, 99.1, 672.1], rtol=1e-3)
    assert_allclose(found.poles.imag, 0, atol=1e-6)


def test_the_printed_equation_is_uninverted() -> None:
    """A force at rest gives the displacement K^-1 f; (6.14) as printed gives K f, hundreds of thousands of times off."""
    truth, force = chain((7.4, 11.5), 1), np.array([1.0, 0.0])
    model = truth.sampled(DT, range(2), range(2))
    rest = model.C @ np.linalg.solve(np.eye(4) - model.A, model.B @ force)
    assert_allclose(rest, np.linalg.solve(truth.K, force), rtol=1e-9)
    assert np.linalg.norm(truth.K @ force) > 1e5 * np.linalg.norm(rest)


@pytest.mark.parametrize("output", OUTPUTS[:2])
def test_without_noise_the_route_is_right(output: str) -> None:
    """A change of states loses nothing."""
    truth = chain((7.4, 11.5), 1)
    found = solve_unconstrained(truth.sampled(DT, range(2), range(2), output), output)
    for name in "MDK":
        assert relative_error(getattr(found, name), getattr(truth, name)) < 1e-8
    assert judge_character(truth).physical


def test_under_noise_the_route_loses_what_the_constraints_keep() -> None:
    """At 20 dB its matrices are not symmetric and its damping is worse than ours."""
    truth = chain((7.4, 11.5, 14.0), 2)
    model = refined(truth.sampled(DT, range(3), range(3)), 20, 5000, np.random.default_rng(0))
    plain, ours = solve_unconstrained(model.model), fit_mechanical(model)
    assert np.all(judge_character(plain).asymmetry > 1e-4)
    assert relative_error(plain.D, truth.D) > 1.5 * relative_error(ours.D, truth.D)


def test_what_the_route_cannot_do_is_said() -> None:
    """It needs as many inputs as outputs, two states an output, and outputs that see all of them."""
    truth = chain((7.4, 11.5, 14.0), 2)
    with raises_code("not_identifiable"):
        solve_unconstrained(truth.sampled(DT, [0], range(3)))
    with raises_code("not_identifiable", "6"):
        solve_unconstrained(truth.sampled(DT, [0, 1], [0, 1]))
    model = truth.sampled(DT, range(3), range(3))
    with raises_code("not_identifiable"):
        solve_unconstrained(replace(model, C=model.C[[0, 1, 1]]))
