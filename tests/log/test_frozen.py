"""An encoder that died, and one that rests."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.log import Log, check_log, list_data_warnings, mend_log
from tau_dyn.log.check_motion import find_dead_force
from tau_dyn.log.signal_checks import find_frozen_positions, find_jumps
from tau_dyn.message_codes import get_code

T = np.arange(10000) / 500
PARKED = np.clip((T - 8) / 4, 0, 1)
"""From 0 before 8 s to 1 after 12 s: how far the joint has come to its rest."""


def swing(rng, noise: float = 2e-5, rest: float = 0.0) -> Log:
    """Return 20 s of a joint that swings, and comes smoothly to a rest by a share."""
    q = (0.8 * np.sin(2.3 * T) + 0.2 * np.sin(6.1 * T + 1)) * (1 - rest * PARKED**2 * (3 - 2 * PARKED))
    v = np.gradient(q, T)
    tau = 5 * np.gradient(v, T) + 3 * np.tanh(v / 0.01) + 0.1 * rng.standard_normal(T.size)
    return Log(T, {"q_a": q + noise * rng.standard_normal(T.size), "tau_a": tau}, "swing.csv")


@pytest.mark.parametrize("start", [5000, 4000, 6123])
def test_an_encoder_that_dies_in_motion_is_left_out(rng, start: int) -> None:
    """No joint stops within a sample: the stretch of one value is named with its times, and is in no fit."""
    q = swing(rng).channels["q_a"].copy()
    q[start : start + 3000] = q[start]
    log = swing(rng).with_channels(q_a=q)
    (warning,) = list_data_warnings(log)
    assert get_code(warning) == "held_channel" and f"q_a stays at the same value from {T[start]:g} to" in warning
    mended = mend_log(log)
    assert mended.n_samples == pytest.approx(7000, abs=2)
    assert not check_log(log).fit_for_use


def test_an_encoder_that_dies_at_a_reversal_is_told_by_its_noise(rng) -> None:
    """Noise of 20 urad does not fade with speed, and the joint's force goes on."""
    log = swing(rng)
    q = log.channels["q_a"].copy()
    turn = int(np.argmax(q[3000:4500])) + 3000
    q[turn:] = q[turn]
    (stretch,) = find_frozen_positions(log.with_channels(q_a=q), "a")
    assert stretch.start <= turn < stretch.stop == T.size


@pytest.mark.parametrize("count", [1e-4, 2e-3])
def test_an_encoder_coarser_than_its_noise_may_rest(rng, count: float) -> None:
    """The joint comes smoothly to a rest of ten seconds; its rounded position keeps one value."""
    log = swing(rng, noise=count / 20, rest=1.0)
    rounded = log.with_channels(q_a=np.round(log.channels["q_a"] / count) * count)
    assert np.ptp(rounded.channels["q_a"][7000:]) == 0
    assert not find_frozen_positions(rounded, "a") and not find_frozen_positions(log, "a")


def test_vibration_that_fades_at_rest_is_no_flicker(rng) -> None:
    """Noise that grows with the speed tells nothing of the encoder at rest."""
    log = swing(rng, noise=0.0, rest=1.0)
    q = log.channels["q_a"]
    speed = np.abs(np.gradient(q)) / np.abs(np.gradient(q)).max()
    shaken = np.round((q + 5e-5 * np.minimum(1, 3 * speed) * rng.standard_normal(q.size)) / 1e-6) * 1e-6
    assert not find_frozen_positions(log.with_channels(q_a=shaken), "a")


def test_a_resting_encoder_steps_by_one_count(rng) -> None:
    """A joint at rest moves between neighbouring counts; a reading that is lost leaves by far more."""
    q = 0.6 + 1e-9 * rng.standard_normal(5000)
    q[1000:] += 1e-4
    q[3000:] -= 1e-4
    assert not len(find_jumps(q, count=1e-3))
    q[4000] = 0.0
    assert len(find_jumps(q, count=1e-3))


def test_a_force_that_dies_is_left_out(rng) -> None:
    """Two seconds of one value of a noisy force."""
    log = swing(rng)
    tau = log.channels["tau_a"].copy()
    tau[3000:4000] = tau[3000]
    (warning,) = list_data_warnings(log.with_channels(tau_a=tau))
    assert get_code(warning) == "held_channel" and "tau_a stays at the same value from 6 to" in warning
    assert mend_log(log.with_channels(tau_a=tau)).n_samples == pytest.approx(9000, abs=2)


def damp(rng, tau: np.ndarray, level: float, noise: float, inside: slice) -> np.ndarray:
    """Return a force (N,) that is a level with noise inside a stretch."""
    tau = tau.copy()
    tau[inside] = level + noise * rng.standard_normal(tau[inside].size)
    return tau


@pytest.mark.parametrize(("level", "noise", "start", "stop"), [(0.9, 0.1, 6210, 10000), (-2.0, 1e-3, 0, 4100)])
def test_a_force_that_is_only_noise_is_left_out(rng, level: float, noise: float, start: int, stop: int) -> None:
    """An accelerated inertia needs a force; a level with noise is a dead sensor, named with its times."""
    log = swing(rng)
    dead = log.with_channels(tau_a=damp(rng, log.channels["tau_a"], level, noise, slice(start, stop)))
    (warning,) = list_data_warnings(dead)
    assert get_code(warning) == "held_channel" and f"tau_a is {level:g} with noise" in warning
    assert mend_log(dead).n_samples == pytest.approx(10000 - (stop - start), abs=8)
    assert not check_log(dead).fit_for_use and not list_data_warnings(log)


def test_a_steady_force_of_a_resting_joint_is_alive(rng) -> None:
    """A joint that stops needs no varying force."""
    log = swing(rng, noise=1e-3, rest=1.0)
    held = damp(rng, log.channels["tau_a"], 3.0, 1e-3, slice(6000, None))
    assert not find_dead_force(log.with_channels(tau_a=held), "a")


def test_a_small_force_that_follows_the_motion_is_alive(rng) -> None:
    """A spring that balances the inertia at one frequency leaves friction, which follows the direction of motion."""
    log = swing(rng)
    v = np.gradient(0.8 * np.sin(2.3 * T) + 0.2 * np.sin(6.1 * T + 1), T)
    tau = np.where(T > 10, 0.05 * np.tanh(v / 0.01) + 0.01 * rng.standard_normal(T.size), log.channels["tau_a"])
    assert not find_dead_force(log.with_channels(tau_a=tau), "a")


def test_a_force_logged_twice_is_named(rng) -> None:
    """Two joints that move differently never have the same force to the last digit; two that move alike may."""
    log = swing(rng)
    q = log.channels["q_a"]
    twice = log.with_channels(q_b=0.5 * q[::-1], tau_b=log.channels["tau_a"])
    (warning,) = list_data_warnings(twice)
    assert get_code(warning) == "joints_exchanged" and "tau_a and tau_b are equal" in warning
    assert not check_log(twice).fit_for_use
    assert not list_data_warnings(log.with_channels(q_b=q, tau_b=log.channels["tau_a"]))
