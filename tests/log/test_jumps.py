"""Positions that jump are told from motion: turns of an encoder, lost readings and a new zero, and nothing that a joint does."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.log import Log, check_jumps, check_log
from tau_dyn.log.signal_checks import find_jumps


def said(log: Log, **known) -> str:
    found = check_jumps(log, "axis", **known)
    return "" if found is None else f"{found.sentence} {found.remedy}"


def test_an_encoder_that_begins_anew_each_turn_is_to_be_unwrapped(axis_log):
    """The angle modulo a turn: the jumps are counted, and the remedy is one line; a slide has no turns."""
    angle = np.mod(30 * axis_log.channels["q_axis"], 2 * np.pi)
    log = axis_log.with_channels(q_axis=angle)
    times = int(np.sum(np.abs(np.diff(angle)) > 3))
    assert times > 20 and f"jumps {times} times" in said(log, revolute=True)
    assert "numpy.unwrap" in said(log, revolute=True) and "unwrap" not in said(log, revolute=False)
    assert not check_log(log).fit_for_use
    whole = axis_log.with_channels(q_axis=np.unwrap(angle))
    assert said(whole) == ""


@pytest.mark.parametrize("lost", [1, 3])
def test_lost_readings_are_named_with_their_time(axis_log, lost: int):
    """A reading of zero in the middle of a stroke is a jump there and back, at 1 kHz 400 m/s."""
    q = axis_log.channels["q_axis"].copy()
    for k in (1503, 7204):
        q[k : k + lost] = 0.0
    assert list(find_jumps(q)) == [1502, 1502 + lost, 7203, 7203 + lost]
    sentence = said(axis_log.with_channels(q_axis=q), revolute=False)
    assert "jumps 4 times" in sentence and "after t = 1.502 s" in sentence and "readings were lost" in sentence


def test_an_encoder_that_is_set_anew_is_named(axis_log):
    """From one sample on everything is 30 mm further; a step of 1 % of the range is noise to nobody, and none of ours."""
    step = np.where(axis_log.t > 10, 1.0, 0.0)
    assert "reset" in said(axis_log.with_channels(q_axis=axis_log.channels["q_axis"] + 0.03 * step))
    assert said(axis_log.with_channels(q_axis=axis_log.channels["q_axis"] + 0.006 * step)) == ""


@pytest.mark.parametrize("rate", [5, 10, 50, 250, 1000])
@pytest.mark.parametrize("grain", [0.0, 1e-4, 2e-3])
def test_no_motion_is_called_a_jump(rate: int, grain: float, rng) -> None:
    """Quick strokes between long rests, sampled seldom or often, by coarse encoders, held over samples, with noise."""
    t = np.arange(0, 60, 1 / rate)
    phase = np.clip(np.mod(t, 6.0) / 0.4, 0, 1)  # a stroke of 0.4 s every 6 s, there and back
    stroke = phase * phase * (3 - 2 * phase)
    q = 0.5 * np.where(np.mod(t // 6, 2) == 0, stroke, 1 - stroke) + 0.01 * np.sin(2 * np.pi * 0.3 * t)
    held = np.repeat(q[::4], 4) if rate >= 50 else q
    for x in (q, held, q + 1e-5 * rng.standard_normal(len(q))):
        assert not find_jumps(np.round(x / grain) * grain if grain else x).size


def test_a_quick_move_seen_by_three_samples_is_motion() -> None:
    """Indexing by 0.1 rad in 30 ms, logged at 100 Hz, with long rests in which only the encoder's noise moves."""
    rng = np.random.default_rng(4)
    steps = np.zeros(4000)
    for k in range(50, 3900, 200):
        steps[k : k + 3] = [0.02, 0.06, 0.02]
    q = np.cumsum(steps) + 1e-5 * rng.standard_normal(4000)
    assert not find_jumps(q).size
    q[2000:] += 0.1
    assert list(find_jumps(q)) == [1999]


def test_a_step_within_the_joints_own_speed_is_motion(axis_log):
    """What the robot file allows in a sample is no jump, and samples that nobody uses may hold anything."""
    q = axis_log.channels["q_axis"].copy()
    q[1503] = 0.0
    log = axis_log.with_channels(q_axis=q)
    size = abs(q[1502])
    assert said(log, fastest=900 * size) and said(log, fastest=np.inf) and not said(log, fastest=1100 * size)
    assert not said(log, left_out=np.arange(len(q)) == 1503)


def test_a_count_of_an_encoder_at_rest_is_no_jump_after_resampling() -> None:
    """One count of 0.38 mrad, which interpolation splits with rounding and some ringing; a step of 30 mrad remains a jump."""
    ringing = 1e-9 * np.sin(np.arange(400.0)) * np.exp(-np.arange(400.0) / 9)
    for count in (3.8e-4, 0.03):
        q = np.zeros(400)
        q[200:], q[201:] = 0.92 * count, count
        q[395] -= 0.6 * count
        q[396:] -= count
        q = 0.048 + q + np.roll(ringing, 203)
        assert bool(find_jumps(q, count=0.02).size) is (count > 0.02)


def test_a_longer_interval_allows_a_larger_step() -> None:
    """A joint pushed at 0.2 rad/s between rests, polled every 20 to 80 ms, does not jump; by the same steps of 20 ms it does."""
    rng = np.random.default_rng(8)
    t = np.cumsum(np.where(rng.uniform(size=3000) < 0.1, 0.08, 0.02))
    pushed = np.mod(t, 30.0) < 0.3
    q = np.cumsum(np.where(pushed, 0.2 * np.diff(t, prepend=0.0), 0.0)) + 1e-5 * rng.standard_normal(len(t))
    assert not find_jumps(q, t=t).size
    q[1500:] += 0.3
    assert list(find_jumps(q, t=t)) == [1499]
