"""Copies are found by their noise: whatever clock, rate and digits they have; a motion that is repeated is no copy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tau_dyn.identify import has_common_samples
from tau_dyn.log import Log

RATE_HZ = 250.0


def run_pendulum(noise_seed: int, *, seconds: float = 20.0, friction: float = 2.0, track: float = 0.0) -> Log:
    """Return a run of one motion of two joints with gravity, friction, gear ripple and noise of its own."""
    random = np.random.default_rng(noise_seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    channels = {}
    for k, joint in enumerate(("shoulder", "elbow")):
        slow = np.sin(0.9 * t + k) + 0.4 * np.sin(2.3 * t) + 0.2 * np.sin(4.1 * t + k)
        wander = track * np.cumsum(random.standard_normal(t.size)) / np.sqrt(t.size)
        q, v = slow + wander, np.gradient(slow, t)
        tau = 30 * np.cos(q) + 5 * np.tanh(v / 0.01) + friction * v + 0.2 * np.sin(40 * q)
        channels[f"q_{joint}"] = np.round((q + 1.2e-5 * random.standard_normal(t.size)) / 2e-5) * 2e-5
        channels[f"tau_{joint}"] = tau + 0.3 * random.standard_normal(t.size)
    return Log(t, channels, f"run{noise_seed}.csv")


def change(log: Log, of_q: Callable, of_tau: Callable) -> Log:
    """Return a log with its positions and its forces changed."""
    changed = {c: (of_q if c.startswith("q_") else of_tau)(x) for c, x in log.channels.items()}
    return Log(log.t, changed, "copy.csv")


def resample(log: Log, rate_hz: float, start: float = 0.0) -> Log:
    """Return a log read at another rate by linear interpolation."""
    t = np.arange(start, log.t[-1], 1 / rate_hz)
    return Log(t, {c: np.interp(t, log.t, x) for c, x in log.channels.items()}, "copy.csv")


def add_noise(log: Log, of_q: float = 1e-5, of_tau: float = 0.1) -> Log:
    """Return a log with more noise on positions and forces."""
    random = np.random.default_rng(99)
    return change(
        log,
        lambda q: q + of_q * random.standard_normal(q.size),
        lambda tau: tau + of_tau * random.standard_normal(tau.size),
    )


def shift(log: Log, seconds: float) -> Log:
    """Return a log on another clock."""
    return Log(log.t + seconds, dict(log.channels), "copy.csv")


COPIES = {
    "the same samples on another clock": lambda log: shift(log, 1e4),
    "a clock in milliseconds": lambda log: Log(1e3 * log.t, dict(log.channels), "copy.csv"),
    "an excerpt": lambda log: shift(log[1000:1100], -3.0),
    "a tenth of the samples lost": lambda log: Log(
        log.t[np.arange(log.n_samples) % 10 > 0],
        {c: x[np.arange(log.n_samples) % 10 > 0] for c, x in log.channels.items()},
    ),
    "every fifth sample": lambda log: log[::5],
    "every fifth sample, rounded": lambda log: change(log[::5], lambda q: q.round(3), lambda tau: tau.round(1)),
    "rounded far above the noise": lambda log: change(log, lambda q: q.round(2), lambda tau: tau.round(0)),
    "added noise": add_noise,
    "an excerpt with added noise on another clock": lambda log: shift(add_noise(log)[1000:4000], 50.0),
    "another rate": lambda log: resample(log, 100.0, 0.0013),
    "a higher rate with added noise": lambda log: add_noise(resample(log, 300.0, 0.0013), of_tau=0.03),
    "degrees and another sign": lambda log: change(log, lambda q: 57.3 * q, lambda tau: -2 * tau.round(3) + 1),
}


@pytest.mark.parametrize("kind", COPIES)
def test_a_copy_shares_its_noise_with_the_original(kind: str) -> None:
    """Neither clock nor rate, digits, units and a little noise make other data of a recording."""
    log = run_pendulum(0)
    copy = COPIES[kind](log)
    assert has_common_samples(log, copy) and has_common_samples(copy, log)


@pytest.mark.parametrize("track", [0.0, 1e-3])
@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("friction", [2.0, 2.05])
def test_a_repeated_motion_is_no_copy(track: float, every: int, friction: float) -> None:
    """Positions and forces agree within noise, and the noise is another one."""
    first, second = run_pendulum(1), run_pendulum(2, friction=friction, track=track)
    assert not has_common_samples(first[::every], second[::every])


def test_logs_with_the_same_noise_and_other_forces_are_no_copies() -> None:
    """Simulations with one seed share noise and motion; a payload makes other data of them."""
    log = run_pendulum(3)
    loaded = Log(log.t, {**log.channels, "tau_elbow": log["tau_elbow"] + np.cos(log["q_elbow"])}, "loaded.csv")
    assert not has_common_samples(log, loaded)


def test_positions_alone_make_no_copy() -> None:
    """A robot without force columns that repeats a command has the same positions in every run."""
    log = run_pendulum(4)
    positions = [Log(log.t + k, {"q_elbow": log["q_elbow"]}, f"{k}.csv") for k in range(2)]
    assert not has_common_samples(*positions)


def test_parts_of_one_recording_share_only_where_they_overlap() -> None:
    """The first and the second half are two data sets; two thirds from each end are not."""
    log = run_pendulum(5)
    assert not has_common_samples(log[:2500], shift(log[2500:], -10.0))
    assert has_common_samples(log[:3500], shift(add_noise(log)[1500:], -6.0))


def test_resting_rows_prove_nothing() -> None:
    """A joint that rests between coarse counts repeats its rows in every log."""
    t = np.arange(500) / 100
    logs = [Log(t + k, {"q_axis": np.zeros(500), "tau_axis": np.round(np.sin(t + k) > 0)}, f"{k}.csv") for k in (0, 1)]
    assert not has_common_samples(*logs)
