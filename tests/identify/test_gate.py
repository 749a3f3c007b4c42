"""Which samples a fit may use: those with a sure direction, away from reversals, limits and flags, faded in."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.effects import EFFECTS, Motion
from tau_dyn.identify import Preparation, choose_preparation
from tau_dyn.identify.preparation import (
    MIN_SEGMENT_SAMPLES,
    compute_gate,
    find_excluded_samples,
    hold_closed,
)
from tau_dyn.log import Log, compute_noise_gain, compute_rest_speed, estimate_encoder_noise, find_motion_band
from tau_dyn.model import Model

RATE, N = 1000.0, 1000
FILTERS = Preparation(200.0, 60.0, 150.0, np.array([0.1, 0.2]), 0.010)
HALF, RAMP = 10, 5  # samples: the window, and a period of the position filter


def gate(two_link, v: np.ndarray, *effects, preparation: Preparation = FILTERS, **channels: np.ndarray) -> np.ndarray:
    """Return the gate (N, 2) of two joints at these speeds."""
    zero = np.zeros((N, 2))
    log = Log(np.arange(N) / RATE, {"tau_shoulder": zero[:, 0], "tau_elbow": zero[:, 1], **channels}, "made.csv")
    motion = Motion.of(two_link.actuated, zero, v, zero)
    return compute_gate(log, motion, Model.of(two_link, effects), preparation, RATE)


def shut_around(first: int, last: int) -> np.ndarray:
    """Return which samples (N,) are shut altogether around some that are bad."""
    k = np.arange(N)
    return (k >= first - HALF + RAMP + 1) & (k <= last + HALF - RAMP - 1)


def check(found: np.ndarray, first: int, last: int) -> None:
    """Compare with one where nothing is near, nothing well inside, and a ramp that falls and rises once between."""
    k = np.arange(N)
    near = (k >= first - HALF - RAMP - 1) & (k <= last + HALF + RAMP + 1)
    assert_array_equal(found[~near], 1.0)
    assert_allclose(found[shut_around(first, last)], 0.0, atol=1e-12)
    assert np.all(np.diff(found[: first + 1]) <= 1e-12) and np.all(np.diff(found[last:]) >= -1e-12)
    assert found[first - HALF - 1] == pytest.approx(
        1 - found[first - HALF], abs=1e-9
    )  # half way down at the window's edge


def test_a_slow_stretch_is_left_out_with_a_window_around_it(two_link) -> None:
    """Of the joint that is slow alone; a speed at the threshold has no sure sign."""
    v = np.full((N, 2), 0.3)
    v[400:420, 1] = 0.2
    found = gate(two_link, v)
    assert_array_equal(found[:, 0], 1.0)
    check(found[:, 1], 400, 419)


def test_a_turn_between_two_fast_samples_is_left_out(two_link) -> None:
    """The first sample of the other sign is unsure."""
    v = np.full((N, 2), 0.3)
    v[500:, 0] *= -1
    found = gate(two_link, v)
    check(found[:, 0], 500, 500)
    assert_array_equal(found[:, 1], 1.0)


def test_a_shared_motors_turns_are_left_out_of_both_joints(two_link) -> None:
    """Where the sum of two speeds is below the root of their thresholds' squares; other effects have no speeds of their own."""
    v = np.column_stack([np.full(N, 0.5), np.full(N, 0.5)])
    v[300:310, 1] = -0.5 + 0.22  # sum 0.22 < hypot(0.1, 0.2) = 0.2236, each fast enough
    v[600:610, 1] = -0.5 + 0.23
    plain = gate(two_link, v, EFFECTS["quadratic_drag"](two_link.actuated, two_link.force_units))
    assert_array_equal(plain[:, 0], 1.0)
    found = gate(two_link, v, EFFECTS["reducer_coupling"](two_link.actuated, two_link.force_units))
    check(np.concatenate([found[:450, 0], np.ones(550)]), 300, 309)
    assert_array_equal(found[:310, 1], found[:310, 0])
    assert_array_equal(found[640:, 0], 1.0)
    assert found[605, 0] == 1.0 and found[605, 1] < 1.0  # the second joint turned there by itself


def test_flags_shut_all_joints_and_limits_their_own(two_link) -> None:
    """From 99.9 % of a drive's limit on; a flag is anything but zero, a hole in it too."""
    joints, limit = two_link.actuated, np.array([100.0, 50.0])
    tau = np.array([[99.8, 0.0], [99.9, 0.0], [-100.0, 0.0], [0.0, 49.96], [0.0, -49.94]])
    log = Log(np.arange(5.0), {"tau_shoulder": tau[:, 0], "tau_elbow": tau[:, 1], "flag": np.array([0, 0, 0, 0, -0.5]),
                               "hole": np.array([np.nan, 0, 0, 0, 0])}, "made.csv")  # fmt: skip
    expected = np.array([[0, 0], [1, 0], [1, 0], [0, 1], [0, 0]], bool)
    assert_array_equal(find_excluded_samples(log, joints, limit, ()), expected)
    flagged = expected.copy()
    flagged[4] = True
    assert_array_equal(find_excluded_samples(log, joints, limit, ("flag",)), flagged)
    flagged[0] = True
    assert_array_equal(find_excluded_samples(log, joints, limit, ("flag", "hole")), flagged)
    assert not find_excluded_samples(log, joints, np.full(2, np.inf), ()).any()
    with raises_code("missing_column", "made.csv"):
        find_excluded_samples(log, joints, limit, ("bad",))


T = np.arange(20_000) / RATE
Q = 0.2 * np.sin(2 * np.pi * 1.0 * T) + 0.05 * np.sin(2 * np.pi * 2.5 * T)


def axis_log(seed: int = 0, noise: float = 1e-6, rate_hz: float = RATE, q: np.ndarray = Q) -> Log:
    rng = np.random.default_rng(seed)
    return Log(
        np.arange(len(q)) / rate_hz,
        {"q_axis": q + noise * rng.normal(size=len(q)), "tau_axis": np.cos(q)},
        f"log{seed}",
    )


def test_filters_follow_from_motion_and_noise_by_rule(axis) -> None:
    """`f_w = min(5 f_b, f_noise, 0.16 f_s)`, `f_q = min(8 f_w, 0.4 f_s)`, 2.5 f_w, ten times a speed's noise, two periods."""
    log = axis_log()
    band = find_motion_band(log.joint("q", ["axis"]), RATE)
    chosen = choose_preparation(axis, [log], ("flag",))
    assert band.edge_hz[0] == pytest.approx(2.5, abs=0.3)
    assert chosen.force_cutoff_hz == pytest.approx(min(5 * band.edge_hz[0], band.noise_edge_hz[0], 160))
    assert chosen.position_cutoff_hz == pytest.approx(min(8 * chosen.force_cutoff_hz, 400))
    assert chosen.rate_hz == pytest.approx(2.5 * chosen.force_cutoff_hz)
    assert chosen.window_s == pytest.approx(2 / chosen.position_cutoff_hz) and chosen.exclude == ("flag",)
    speed_noise = estimate_encoder_noise(log.joint("q", ["axis"])) * compute_noise_gain(RATE, chosen.position_cutoff_hz)
    assert_allclose(chosen.speed_threshold, 10 * speed_noise)


def test_of_several_logs_the_widest_motion_the_noisier_encoder_and_the_slowest_clock_count(axis) -> None:
    """Fitted together, filtered alike."""
    slow, fast, noisy = axis_log(), axis_log(1, q=0.1 * np.sin(2 * np.pi * 6.0 * T)), axis_log(2, noise=1e-4)
    bands = [find_motion_band(log.joint("q", ["axis"]), RATE) for log in (slow, fast)]
    expected = min(5 * max(b.edge_hz[0] for b in bands), min(b.noise_edge_hz[0] for b in bands), 160.0)
    assert bands[1].edge_hz[0] > 2 * bands[0].edge_hz[0]
    assert choose_preparation(axis, [slow, fast]).force_cutoff_hz == pytest.approx(expected)
    assert choose_preparation(axis, [fast, slow]).force_cutoff_hz == pytest.approx(expected)
    assert (
        choose_preparation(axis, [slow, noisy]).speed_threshold > 5 * choose_preparation(axis, [slow]).speed_threshold
    )
    coarse = axis_log(3, rate_hz=20.0, q=0.2 * np.sin(2 * np.pi * np.arange(20_000) / 20.0))
    assert choose_preparation(axis, [coarse]).force_cutoff_hz <= 0.16 * 20.0 + 1e-9
    assert choose_preparation(axis, [coarse, slow]).force_cutoff_hz == pytest.approx(
        max(0.16 * 20.0, find_motion_band(slow.joint("q", ["axis"]), RATE).edge_hz[0]), rel=1e-6
    )


def test_logs_without_a_motion_a_clock_or_samples_have_no_filters(axis) -> None:
    """Each with its reason: encoder noise, a clock that is not in seconds, nine samples."""
    with raises_code("poor_excitation", "log0"):
        choose_preparation(axis, [axis_log(q=np.zeros(5000), noise=1e-5)])
    with raises_code("wrong_unit", "log0", "1"):
        choose_preparation(axis, [axis_log(rate_hz=1.0)])
    with raises_code("too_little_data", "log0", f"{MIN_SEGMENT_SAMPLES - 1}", f"{MIN_SEGMENT_SAMPLES}"):
        choose_preparation(axis, [axis_log(1), axis_log(q=Q[: MIN_SEGMENT_SAMPLES - 1])])


@pytest.mark.parametrize(
    ("rate_hz", "factor"), [(1000.0, 6), (150.0, 1), (149.0, 1), (300.0, 2), (299.9999, 2), (299.0, 1), (449.0, 2)]
)
def test_decimation_is_a_whole_number_that_keeps_the_rate(rate_hz: float, factor: int) -> None:
    """150 Hz at least, of a clock's rounding no less."""
    assert FILTERS.factor(rate_hz) == factor
    assert FILTERS.to_dict()["speed_threshold"] == [0.1, 0.2]


@pytest.mark.parametrize(("n", "first", "last"), [(0, 7, 7), (1, 7, 8), (4, 7, 11), (-1, 6, 7), (-4, 3, 7)])
def test_a_late_force_keeps_the_gate_shut_for_longer(n: int, first: int, last: int) -> None:
    """A force n samples late has its reversal up to n samples after the motion's; an early one before it."""
    wide = np.ones(15)
    wide[7] = 0.0
    expected = np.ones(15)
    expected[first : last + 1] = 0.0
    assert_array_equal(hold_closed(wide, n), expected)


def test_a_joint_with_smoothed_positions_rests_below_a_share_of_its_speed() -> None:
    """Without noise 2 % of the fast speed count as rest; with an encoder's noise, ten times what it makes of the speed."""
    t = np.arange(4000) / 250
    q = np.column_stack([np.sin(1.3 * t), 0.5 * np.sin(2.1 * t)])
    v = np.column_stack([1.3 * np.cos(1.3 * t), 1.05 * np.cos(2.1 * t)])
    smooth = compute_rest_speed(q, 250.0, 20.0)
    assert_allclose(smooth, 0.02 * np.quantile(np.abs(v), 0.95, axis=0), rtol=0.01)
    noisy = q + 1e-5 * np.random.default_rng(0).standard_normal(q.shape)
    expected = 10 * estimate_encoder_noise(noisy) * compute_noise_gain(250.0, 20.0)
    assert_allclose(compute_rest_speed(noisy, 250.0, 20.0), expected)
