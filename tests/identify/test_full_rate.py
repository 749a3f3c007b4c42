"""Equations at a log's own rate: which count, what stands in them, and mass matrices between every tenth sample."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import REACH, compute_accelerations
from tau_dyn.identify import build_model, choose_preparation, find_unsure_samples, widen
from tau_dyn.identify.full_rate import (
    INERTIA_EVERY,
    SIGN_THRESHOLD_RATIO,
    _inertia as inertia_of,
    build_full_rate_equations,
)
from tau_dyn.log import Log, compute_edge_samples
from tau_dyn.model import Model

RATE, N = 500.0, 3000
T = np.arange(N) / RATE


@pytest.fixture
def arm(two_link) -> tuple[Model, Log]:
    """Two links on two sines with a flagged stretch, and friction."""
    q = np.column_stack([0.5 * np.sin(2 * T), 0.4 * np.cos(3 * T)])
    flag = np.zeros(N)
    flag[1500:1510] = 1
    model = build_model(two_link, "asymmetric")
    channels = {
        f"{s}_{j}": x
        for s, X in (("q", q), ("tau", 3 * np.cos(q)))
        for j, x in zip(two_link.actuated, X.T, strict=True)
    }
    return model, Log(T, {**channels, "flag": flag}, "arm.csv")


def test_columns_hold_the_accelerations_of_raw_positions(arm) -> None:
    """Mass columns by second differences, friction by the low-passed speed; other accelerations go into the same columns."""
    model, log = arm
    found = build_full_rate_equations(model, log, choose_preparation(model.robot, [log]))
    q, v = found.smooth
    raw = log.joint("q", model.robot.actuated)
    assert_array_equal(found.position, raw)
    assert_array_equal(found.force, log.joint("tau", model.robot.actuated))
    expected = model.columns(model.motion(q, v, compute_accelerations(raw, log.dt), np.sign(v), t=log.t))
    assert_allclose(found.W, expected, rtol=1e-12)
    other = np.cos(raw)
    assert_allclose(
        found.columns(model, other), model.columns(model.motion(q, v, other, np.sign(v), t=log.t)), rtol=1e-12
    )
    inner = slice(200, -200)
    exact = np.column_stack([np.cos(2 * T), -1.2 * np.sin(3 * T)])
    assert_allclose(v[inner], exact[inner], atol=2e-3)


def test_equations_count_where_signs_are_sure_and_nothing_is_flagged(arm) -> None:
    """Not at the filter's ends, not near a reversal of a joint, not within an acceleration's reach of a flagged sample."""
    model, log = arm
    chosen = choose_preparation(model.robot, [log], ("flag",))
    found = build_full_rate_equations(model, log, chosen)
    edge = compute_edge_samples(chosen.position_cutoff_hz, RATE)
    assert not found.keep[:edge].any() and not found.keep[N - edge :].any()
    assert found.keep[edge : edge + 20].any() and found.keep[N - edge - 20 : N - edge].any()
    assert not found.keep[1500 - REACH : 1510 + REACH].any()
    plain = build_full_rate_equations(model, log, choose_preparation(model.robot, [log]))
    around = [1500 - REACH - 1, 1510 + REACH]
    assert_array_equal(found.keep[around], plain.keep[around])
    _, v = found.smooth
    slow = np.abs(v) < SIGN_THRESHOLD_RATIO * chosen.speed_threshold
    assert not found.keep[slow].any() and 0.8 < found.keep[edge : N - edge].mean() < 1


def test_a_sign_is_sure_out_of_reach_of_slow_samples_and_jumps() -> None:
    """Two samples on either side of one that is slow, or where the sign turns between two that are not; joint by joint."""
    v = np.ones((30, 2))
    v[10, 0] = 0.1  # slow
    v[20:, 0] = -1.0  # turns between 19 and 20
    sure = ~widen(find_unsure_samples(v, np.array([0.2, 0.2])), REACH)
    expected = np.ones(30, bool)
    expected[10 - REACH : 10 + REACH + 1] = expected[20 - REACH : 20 + REACH + 1] = False
    assert_array_equal(sure[:, 0], expected)
    assert sure[:, 1].all()
    assert not find_unsure_samples(np.full((5, 1), 0.21), np.array([0.2])).any()


@pytest.mark.parametrize("n", [1, 2, INERTIA_EVERY, INERTIA_EVERY + 1, 57])
def test_mass_matrices_between_every_tenth_are_interpolated(two_link, n: int) -> None:
    """Exact at every tenth and at the last; between them a mean by place, within 1e-4 of a slow motion's."""
    model = build_model(two_link, "rigid")
    q = np.column_stack([0.01 * np.arange(n), 0.2 + 0.004 * np.arange(n)])
    found, exact = inertia_of(model, q), model.mechanism.inertia(q)
    at = np.unique(np.append(np.arange(0, n, INERTIA_EVERY), n - 1))
    assert found.shape == (n, 2, 2)
    assert_allclose(found[at], exact[at], rtol=1e-12)
    assert_allclose(found, exact, atol=1e-4 * np.abs(exact).max())
    if n > INERTIA_EVERY + 1:
        assert_allclose(found[13], 0.7 * exact[10] + 0.3 * exact[20], rtol=1e-12)
