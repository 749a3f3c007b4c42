"""Maximum likelihood of M, D, K: derivatives, whitening, optimality."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from sampling import assert_scatter

sys.path.insert(0, str(Path(__file__).parent))
from structures import chain, relative_error

from tau_dyn.modes.mechanical import SecondOrder
from tau_dyn.modes.mechanical.estimation import (
    Target,
    compute_relative_frame,
    compute_whitening,
    maximise_likelihood,
    split,
)
from tau_dyn.modes.mechanical.fit import compute_worst_relative_stderr, get_covariance
from tau_dyn.modes.mechanical.structure import Places, pack, unpack

RATE = 2 * np.pi * 10.0
S = (0.05 + 1j) * np.geomspace(0.2, 4.0, 30)


def scaled(seed: int = 3) -> SecondOrder:
    truth = chain((7.4, 11.5, 14.0), seed)
    unit = np.trace(truth.K) / 3
    return SecondOrder(truth.M * RATE**2 / unit, truth.D * RATE / unit, truth.K / unit)


def target(truth: SecondOrder, places: Places, noise: float, seed: int = 0) -> Target:
    """Return a response with independent errors of one size."""
    H = places.select(truth.compliance(S))
    rng = np.random.default_rng(seed)
    return Target(S, H + noise * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)), places,
                  np.eye(2 * H.size) / noise, True)  # fmt: skip


def test_the_jacobian_is_the_derivative() -> None:
    """Analytic slopes agree with differences, for fewer sensors than masses too."""
    truth = scaled()
    goal = target(truth, Places((2, 0), (0, 1)), 1.0)
    x, J = pack(truth), goal.jacobian(truth)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-6 * np.abs(x).max()
        slope = (goal.misfit(unpack(x + step, 3)) - goal.misfit(unpack(x - step, 3))) / (2 * step[k])
        assert_allclose(J[:, k], slope, atol=1e-6 * np.abs(slope).max())


def test_whitening_whitens_what_is_uncertain_and_leaves_the_rest() -> None:
    """T C T' is one on the span of C, whatever the rows' sizes; exact rows are left out."""
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(40, 6)) * np.geomspace(1e-6, 1e3, 40)[:, None]
    factor[3] = 0.0
    T = compute_whitening(factor)
    assert T.shape == (6, 40)
    assert_allclose(T @ factor @ factor.T @ T.T, np.eye(6), atol=1e-9)
    assert np.all(T[:, 3] == 0)


def test_the_maximum_is_found_from_afar_and_is_one() -> None:
    """From matrices 30 % off the truth is reached; under noise no small change lowers the misfit."""
    truth = scaled()
    start = SecondOrder(1.3 * truth.M, 0.7 * truth.D, 1.3 * truth.K)
    places = Places((0, 1, 2), (0,))
    exact = maximise_likelihood(Target(S, places.select(truth.compliance(S)), places, np.eye(2 * 90), False), start)
    for name in "MDK":
        assert relative_error(getattr(exact, name), getattr(truth, name)) < 1e-4
    goal = target(truth, places, 1e-3)
    found = maximise_likelihood(goal, start)
    gradient = goal.jacobian(found).T @ goal.misfit(found)
    size = np.linalg.norm(goal.jacobian(found), axis=0)
    assert np.all(np.abs(gradient) < 1e-2 * size)  # a hundredth of a standard error


def test_damping_stays_on_its_edge_where_data_ask_for_less() -> None:
    """A response that gains energy in one direction is met by the least damping there is, not by a negative one."""
    truth = scaled()
    value, vector = np.linalg.eigh(truth.D)
    unruly = SecondOrder(truth.M, truth.D - 1.5 * value[0] * np.outer(vector[:, 0], vector[:, 0]), truth.K)
    found = maximise_likelihood(target(unruly, Places((0, 1, 2), (0, 1, 2)), 1e-4), truth)
    lowest = np.linalg.eigvalsh(found.D)[0]
    assert -1e-12 < lowest < 0.1 * value[0]  # rounding of L L' apart


def test_covariance_is_the_scatter_of_the_estimates() -> None:
    """Estimates from fresh errors scatter as the covariance says."""
    truth, places = scaled(), Places((0, 1, 2), (0,))
    found = [pack(maximise_likelihood(target(truth, places, 1e-3, seed), truth)) for seed in range(60)]
    stated = np.sqrt(np.diag(get_covariance(target(truth, places, 1e-3), truth, None)))
    assert_scatter(np.array(found), stated)


def test_relative_uncertainty_has_no_units() -> None:
    """A change of units changes M and K and not how well they are known."""
    truth, places = scaled(), Places((0, 1, 2), (0, 1, 2))
    known = get_covariance(target(truth, places, 1e-2), truth, None)
    unit = np.outer([1.0, 30.0, 0.1], [1.0, 30.0, 0.1])
    upper = np.tile(unit[np.triu_indices(3)], 3)
    other = SecondOrder(truth.M * unit, truth.D * unit, truth.K * unit)
    a, b = (
        compute_worst_relative_stderr(truth, known),
        compute_worst_relative_stderr(other, known * np.outer(upper, upper)),
    )
    assert_allclose([a["M"], a["K"]], [b["M"], b["K"]], rtol=1e-9)
    frame = compute_relative_frame(truth)
    assert frame.shape == (18, 18) and np.linalg.cond(frame) < 1e6


def test_a_mass_without_trace_is_infinitely_uncertain() -> None:
    """At rest alone no response tells a mass."""
    truth, places = scaled(), Places((0, 1, 2), (0, 1, 2))
    s = np.zeros(4, complex)
    H = truth.compliance(s)
    goal = Target(s, H, places, np.eye(2 * H.size), True)
    assert compute_worst_relative_stderr(truth, get_covariance(goal, truth, None))["M"] == np.inf
    assert split(H).shape == (72,)
