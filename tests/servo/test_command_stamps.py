"""Commands act at their own stamps: a servo answers the mean of the commands that are held within a step of the clock."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.servo.records import average_held_commands

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
