"""A force that is zero between large ones, or stands still in a noisy channel, was not measured."""

from __future__ import annotations

import numpy as np

from tau_dyn.log import list_data_warnings, mend_log
from tau_dyn.log.data_integrity import find_held_runs, find_zero_runs
from tau_dyn.message_codes import RepairedWarning, get_code


def test_forces_logged_as_zero_are_found(axis_log, rng) -> None:
    """A friction of 20 N does not vanish for a millisecond while the axis moves on."""
    tau = axis_log.channels["tau_axis"].copy()
    tau[rng.random(tau.size) < 0.005] = 0.0
    log = axis_log.with_channels(tau_axis=tau)
    assert len(find_zero_runs(log, "axis")) > 50
    assert "zero_force_runs" in {get_code(w) for w in list_data_warnings(log)}


def test_a_force_that_passes_zero_is_no_dropout(axis_log) -> None:
    """At a reversal friction changes its side: a zero in between is a measurement; so is a drive that is off for seconds."""
    tau = np.round(axis_log.channels["tau_axis"])
    tau[5000:8000] = 0.0
    assert not len(find_zero_runs(axis_log.with_channels(tau_axis=tau), "axis"))
    assert not list_data_warnings(axis_log.with_channels(tau_axis=np.round(tau, 1)))


def test_held_forces_are_found_in_a_live_channel(axis_log) -> None:
    """Ten equal values that end in a leap are the last reading, repeated; rounding repeats values, too, but all over."""
    tau = axis_log.channels["tau_axis"]
    slow = np.convolve(tau, np.ones(40) / 40, "same") + 1e-3 * np.sin(np.arange(tau.size))
    coarse = axis_log.with_channels(tau_axis=20 * np.round(slow / 20))
    for k in range(500, tau.size - 200, 400):
        slow[k : k + 60] = slow[k]
    held = axis_log.with_channels(tau_axis=slow)
    assert len(find_held_runs(held, "tau_axis")) >= 3
    assert "held_channel" in {get_code(w) for w in list_data_warnings(held)}
    assert not len(find_held_runs(coarse, "tau_axis"))


def test_short_dropouts_are_interpolated(axis_log, rng) -> None:
    """One reading in a hundred is written as zero: a straight line between its neighbours is right to the force's own noise."""
    tau = axis_log.channels["tau_axis"].copy()
    lost = rng.random(tau.size) < 0.01
    log = axis_log.with_channels(tau_axis=np.where(lost, 0.0, tau))
    (warning,) = list_data_warnings(log)
    mended = mend_log(log).channels["tau_axis"]
    filled = lost & (mended != 0)
    assert isinstance(warning, RepairedWarning) and np.count_nonzero(filled) > 0.8 * np.count_nonzero(lost)
    assert np.std((mended - tau)[filled]) < 3.0
