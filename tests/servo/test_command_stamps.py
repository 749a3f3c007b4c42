"""Commands act at their own stamps: a servo answers the mean of the commands that are held within a step of the clock."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.servo import identify_loop
from tau_dyn.servo.prediction import _pick_stamps
from tau_dyn.servo.records import CLOCK_S, average_held_commands, build_records, move_to_stamps
from tau_dyn.simulate import ServoLaw

from .arms import build_link

DT = 1 / 30


def test_rounded_stamps_keep_their_commands(rng):
    """Stamps of a 30 Hz clock with seven digits, above or below the true time, give each command its own step."""
    t = np.arange(200) * DT
    command = rng.normal(size=(200, 2))
    stamps = np.round(t, 7)
    assert np.any(stamps > t) and np.any(stamps < t)
    assert_allclose(average_held_commands(stamps, command, t, DT), command, rtol=0, atol=0)


def test_a_command_in_the_middle_of_a_step_counts_by_its_share():
    """A command that arrives after a quarter of a step acts for three quarters of it."""
    stamps = np.array([0.0, 1.25, 2.0])
    found = average_held_commands(stamps, np.array([[0.0], [4.0], [1.0]]), np.arange(3.0), 1.0)
    assert_allclose(found[:, 0], [0.0, 3.0, 1.0])


def test_jittered_stamps_keep_the_integral_of_the_command(rng):
    """The integral of the held command over the log is that of the mean commands, whatever the jitter."""
    stamps = np.concatenate([[0.0], np.sort(np.arange(1, 400) * DT + rng.uniform(-0.4, 0.4, 399) * DT)])
    command = rng.normal(size=(400, 1))
    t = np.arange(399) * DT
    found = average_held_commands(stamps, command, t, DT)
    fine = np.arange(0, 399 * DT, DT / 2000)
    held = command[np.searchsorted(stamps, fine, side="right") - 1, 0]
    assert_allclose(found.sum() * DT, held.sum() * DT / 2000, atol=2e-3)


def test_late_stamps_of_one_sample_are_no_delay(rng):
    """Half of the stamps one nanosecond late: no command moves to the next step."""
    t = np.arange(100) * DT
    command = rng.normal(size=(100, 1))
    stamps = t + 1e-8 * (np.arange(100) % 2)
    assert_allclose(average_held_commands(stamps, command, t, DT), command, rtol=0, atol=0)


def swing(rng, jitter_s: float, inertia: float = 0.02, seconds: float = 20.0, jump: float = 0.15) -> Log:
    """Return a log of a link behind a spring of 7.685 N m/rad and 0.5 N m s/rad at 30 Hz, by steps of 0.1 ms of its own.

    The spring's torque is limited to 2.9 N m. Commands jump to `jump` [rad] beside a sine, and back. Each sample is up to
    `jitter_s` early or late, with its true stamp; a command acts from its stamp on.
    """
    n = int(seconds / DT)
    stamps = np.round((np.arange(n) + 0.5) * DT + rng.uniform(-jitter_s, jitter_s, n), 4)
    goal = 0.4 * np.sin(2 * np.pi * 0.5 * stamps) + np.repeat(rng.choice([-jump, jump], n), 36)[:n]
    q, v, positions = goal[0], 0.0, []
    sent = np.searchsorted(stamps, np.arange(int(np.ceil(stamps[-1] * 1e4)) + 1) * 1e-4 + 1e-9, side="right") - 1
    rows = set(np.round(stamps * 1e4).astype(int).tolist())
    for k, now in enumerate(np.maximum(sent, 0).tolist()):
        if k in rows:
            positions.append(q)
        torque = min(max(7.685 * (goal[now] - q), -2.9), 2.9)
        v = (inertia * v + 1e-4 * torque) / (inertia + 1e-4 * 0.5)
        q += 1e-4 * v
    noisy = np.array(positions) + 3e-4 * rng.normal(size=n)
    return Log(stamps - stamps[0], {"cmd_j1": goal, "q_j1": noisy}, name="swing.csv")


@pytest.mark.parametrize("jitter_s", [0.0, 6e-3])
def test_positions_and_commands_count_at_their_own_stamps(rng, jitter_s):
    """A servo logged at 30 Hz, each sample up to 6 ms off the clock, is fitted to its noise of 0.3 mrad, as on an even clock."""
    robot = build_link(0.02)
    law = ServoLaw.of(robot.actuated, position_gain=2.65, force_per_unit=2.9)
    found = identify_loop(robot, swing(rng, jitter_s), law=law)
    assert found.train.rms_per_joint[0] < 3.4e-4
    assert {p.name: p.value for p in found.parameters}["j1.viscous"] == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("jitter_s", [0.0, 6e-3])
def test_a_saturated_servo_answers_a_jump_from_its_stamp_on(rng, jitter_s):
    """Jumps of 0.8 rad saturate a servo, whose mean torque in a step is not that of the mean command: it is fitted to noise."""
    robot = build_link(0.02)
    law = ServoLaw.of(robot.actuated, position_gain=2.65, force_per_unit=2.9)
    found = identify_loop(robot, swing(rng, jitter_s, jump=0.4), law=law)
    assert found.train.rms_per_joint[0] < 3.6e-4


def test_a_parabola_is_exact_at_stamps_between_samples():
    """Positions 1 + 2 t + 3 t^2 on a clock, moved by up to half a step, are those of the stamps."""
    t, apart = np.arange(5.0), np.array([0.0, 0.5, -0.5, 0.2, 0.0])
    assert_allclose(move_to_stamps(1 + 2 * t + 3 * t**2, apart), 1 + 2 * (t + apart) + 3 * (t + apart) ** 2)


def test_a_motion_whose_acceleration_jumps_is_read_at_stamps_from_its_fine_samples():
    """200 rad/s^2 from 12 ms on, on a clock of 5 ms: a parabola over it is 0.3 mrad off, one over steps of 0.5 ms 0.01 mrad."""
    t, apart = 5e-3 * np.arange(6), np.array([0.0, 0.3, 0.4, -0.4, 0.4, 0.0])
    record = SimpleNamespace(t=t, apart=apart)
    fine = 5e-4 * np.arange(51)

    def position(at: np.ndarray) -> np.ndarray:
        return 100 * np.maximum(at - 0.01225, 0.0) ** 2

    found = _pick_stamps(position(fine)[:, None], record, 10)
    assert_allclose(found[:, 0], position(t + 5e-3 * apart), atol=1e-5)


def build_record(log: Log):
    """Return the log of one link on its clock."""
    robot = build_link(0.02)
    return build_records(Model.of(robot), ServoLaw.of(robot.actuated, position_gain=2.65), [log])[0]


def test_uneven_stamps_have_a_clock_finer_than_the_samples(rng):
    """Of a clock of at most 5 ms the samples nearest to a stamp are used; even stamps keep their own clock."""
    even, uneven = (build_record(swing(rng, jitter)) for jitter in (0.0, 6e-3))
    assert even.every == 1 and even.used[31:].all() and even.steps is None
    assert uneven.every == 7 and uneven.dt <= CLOCK_S and uneven.interval == pytest.approx(DT, rel=1e-2)
    assert 561 <= uneven.used.sum() <= 570  # without the first second, in which it moves


def test_a_stream_on_a_fine_clock_has_no_steps(rng):
    """Goals that move by 2 rad/s, 30 times a second, are a stream although each change takes two samples of the clock."""
    stamps = np.arange(300) * DT + rng.uniform(-6e-3, 6e-3, 300)
    goal = 2.0 * stamps
    goal[150:] += 0.5
    record = build_record(Log(stamps - stamps[0], {"cmd_j1": goal, "q_j1": goal}, name="stream.csv"))
    assert record.steps is not None
    times = record.t[record.steps[:, 0]] + stamps[0]
    assert np.abs(times[times > stamps[2]] - stamps[150]).max() < 2 * CLOCK_S and np.any(times > stamps[2])


def test_the_start_of_a_log_in_motion_is_left_out(rng):
    """The simulation starts at rest: of a log of 6 s that begins in motion 0.6 s are not used; one at rest is used."""
    t = np.arange(0, 6, 0.02)
    for q, first in ((0.3 * np.sin(3 * t), 30), (np.where(t < 1, 0.0, np.sin(3 * (t - 1))), 0)):
        q = q + 1e-4 * rng.normal(size=len(t))
        record = build_record(Log(t, {"cmd_j1": q, "q_j1": q}, name="start.csv"))
        assert int(np.argmax(record.used)) == first
    short = build_record(Log(t[:100], {"cmd_j1": np.sin(t[:100]), "q_j1": np.sin(t[:100])}, name="short.csv"))
    assert short.used.all()
