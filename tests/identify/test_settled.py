"""Rounds of an estimation end where another one would move nothing, and not before."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.estimate import Estimate, solve_least_squares
from tau_dyn.identify import build_model, build_regression, full_rate
from tau_dyn.identify.full_rate import estimate_full_rate
from tau_dyn.log import Log
from tau_dyn.model import Model

RATE, N = 1000.0, 5000


@pytest.fixture(scope="module")
def model(axis) -> Model:
    """A drive with asymmetric friction."""
    return build_model(axis, "asymmetric")


@pytest.fixture(scope="module")
def spoilt(model) -> tuple[Log, Estimate]:
    """Five seconds of a drive, one force in a hundred 150 N off, 2 um of encoder noise; and what least squares makes of them."""
    rng, t = np.random.default_rng(8), np.arange(N) / RATE
    q, v, a = (
        0.12 * (5.6**k) * np.sin(5.6 * t + k * np.pi / 2) + 0.02 * (14.5**k) * np.sin(14.5 * t + k * np.pi / 2)
        for k in range(3)
    )
    values = {"carriage_link.mass": 90.0, "axis.coulomb_pos": 20.0, "axis.coulomb_neg": 21.0, "axis.viscous_pos": 160.0}
    truth = model.with_values({**values, "axis.viscous_neg": 240.0})
    force = truth.torque(q[:, None], v[:, None], a[:, None])[:, 0] + 2 * rng.normal(size=N)
    force += 150 * (rng.random(N) < 0.01) * rng.choice([-1, 1], N)
    log = Log(t, {"q_axis": q + 2e-6 * rng.normal(size=N), "tau_axis": force}, "spoilt.csv")
    return log, solve_least_squares(build_regression(model, [log]))


def test_more_rounds_of_weights_change_the_answer_by_nothing_that_counts(model, spoilt, monkeypatch) -> None:
    """The last round moved less than a fiftieth of an error, each next one less by half or more: together at most as much again.

    Twelve rounds, whatever they move, are the answer to compare with; the first alone is a fifth of an error away from it.
    """
    log, first = spoilt
    found = estimate_full_rate(model, [log], first, "robust").estimate
    monkeypatch.setattr(full_rate, "MAX_ITERATIONS", 12)
    monkeypatch.setattr(full_rate, "MAX_CHANGE_STDERRS", -1.0)
    settled = estimate_full_rate(model, [log], first, "robust").estimate
    assert np.max(np.abs(found.beta_plain - settled.beta_plain) / settled.stderr) < 2 * 0.02
    monkeypatch.setattr(full_rate, "MAX_ITERATIONS", 1)
    once = estimate_full_rate(model, [log], first, "robust").estimate
    assert np.max(np.abs(once.beta_plain - settled.beta_plain) / settled.stderr) > 0.2
