"""Fit, whiteness and independence: right on paper, calm on good models, alarmed by bad ones."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parent))
from recordings import recorded, response, structure

from tau_dyn.modes.residuals import Z99, check_independence, check_whiteness, fit_of


def test_fit_is_that_of_the_contract(rng):
    """A perfect simulation fits 100 %, the mean 0 %, and a tenth of the movement missed leaves 90 %."""
    y = rng.normal(size=(500, 2)) + 7
    moved = y - y.mean(axis=0)
    assert_allclose(fit_of([y], [y]), 100)
    assert_allclose(fit_of([y], [np.broadcast_to(y.mean(axis=0), y.shape)]), 0, atol=1e-9)
    assert_allclose(fit_of([y], [y - 0.1 * moved]), 90)


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_independent_signals_pass_whatever_their_colour(rng, colour):
    """Residuals and inputs that have nothing to do with each other fail about one time in a hundred, coloured or not."""
    p = []
    for _ in range(150):
        e, u = (lfilter([1], [1, -colour], rng.normal(size=(600, 1)), axis=0) for _ in range(2))
        p.append(check_independence([e], [u], ["y"], ["u"])[0].p_value)
    assert np.mean(np.array(p) < 0.01) < 0.05  # 1 % expected; 5 % is four standard errors above
    assert 0.2 < np.mean(np.array(p) < 0.5) < 0.8


def test_whiteness_tells_noise_from_its_memory(rng):
    """White noise passes, the same noise through a slow filter does not."""
    white = rng.normal(size=(2000, 1))
    assert check_whiteness([white], ["y"])[0].passed
    assert check_whiteness([white], ["y"])[0].band == pytest.approx(Z99 / np.sqrt(2000))
    assert not check_whiteness([lfilter([1], [1, -0.2], white, axis=0)], ["y"])[0].passed


def test_a_missing_mode_is_seen_in_what_is_left():
    """A model without the second resonance leaves something that answers to the input; the whole model does not."""
    plant, poor = structure(), structure((7.4,), (0.02,))
    record = recorded(plant, decibels=30)
    whole = check_independence([record.y - response(plant, record.u)], [record.u], record.outputs, record.inputs)
    assert all(t.passed for t in whole)
    partial = record.y[:, :1] - response(poor, record.u[:, :1]) * 0.7
    assert not all(t.passed for t in check_independence([partial], [record.u], ["y"], record.inputs))
