"""Channels that are wrong although they move: encoders with a stuck bit, and forces that clip below their noise."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tau_dyn.log import Log, check_log, list_data_warnings
from tau_dyn.message_codes import get_code

T = np.arange(5000) / 250
COUNT = 1e-4
NOISE = 0.15


def swing(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and forces (N,) of a pendulum with friction, without noise."""
    q = sum(0.25 * np.sin(w * T + p) for w, p in zip((1.3, 2.9, 4.1, 5.3), rng.uniform(0, 6, 4), strict=True))
    v = np.gradient(q, T)
    return q, 5 * np.gradient(v, T) + 3 * np.sign(v) + 2 * v + 20 * np.sin(q)


def record(rng: np.random.Generator, q: np.ndarray, tau: np.ndarray) -> Log:
    """Return the log of positions and forces with noise."""
    noisy = tau + NOISE * rng.standard_normal(T.size)
    return Log(T, {"q_a": q + 2e-5 * rng.standard_normal(T.size), "tau_a": noisy}, "swing.csv")


def list_faulty(log: Log) -> list[str]:
    return [w for w in list_data_warnings(log) if get_code(w) == "faulty_channel"]


@pytest.mark.parametrize("bit", [2, 4, 6, 8])
@pytest.mark.parametrize("value", [0, 1])
def test_a_stuck_bit_of_an_encoder_is_named(rng, bit: int, value: int) -> None:
    """The counts take one half of each period of the bit, and a lost carry throws the position back."""
    q, tau = swing(rng)
    log = record(rng, q, tau)
    counts = np.round(log.channels["q_a"] / COUNT).astype(int)
    counts = counts | 1 << bit if value else counts & ~(1 << bit)
    (said,) = list_faulty(log.with_channels(q_a=counts * COUNT))
    assert "a bit of q_a is stuck" in said and f"in each {2 ** (bit + 1) * COUNT:.4g}," in said
    assert not check_log(log.with_channels(q_a=counts * COUNT)).fit_for_use


@pytest.mark.parametrize("size", [0.02, -0.006])
def test_an_encoder_that_slips_is_named_with_its_time(rng, size: float) -> None:
    """The position steps within a sample and the motion goes on: no force does that."""
    q, tau = swing(rng)
    (said,) = list_faulty(record(rng, q + size * (T > 8.2), tau))
    assert f"q_a steps by {size:+.1g}"[:16] in said and "after t = 8.2 s" in said


def test_impacts_and_lost_samples_do_not_slip(rng) -> None:
    """An impact reverses the speed on one side, a lost sample is one step more, a wrong reading comes back, a rest flickers."""
    q, tau = swing(rng)
    bounced = np.where(T < 8.2, q, 2 * q[2050] - q)
    kept = np.delete(np.arange(T.size), 2050)
    lost = np.append(q[kept], q[-1])
    parked = np.round((q * (T < 10) + q[2500] * (T >= 10) + 2e-5 * rng.standard_normal(T.size)) / 1e-4) * 1e-4
    spiked = q + 0.02 * (np.arange(T.size) == 2050)
    for one in (bounced, lost, spiked):
        assert list_faulty(record(rng, one, tau)) == []
    assert list_faulty(record(rng, q, tau).with_channels(q_a=parked)) == []


@pytest.mark.parametrize("count", [1e-4, 8e-4, 5e-3])
def test_coarse_encoders_have_all_their_bits(rng, count: float) -> None:
    """Rounded positions move by one count along the motion, also where they are written with more digits."""
    q, tau = swing(rng)
    log = record(rng, np.round(q / count) * count, tau)
    assert list_faulty(log) == []
    rounded = np.round(q / count) * count
    assert list_faulty(log.with_channels(q_a=rounded)) == []
    assert list_faulty(log.with_channels(q_a=rounded + COUNT * (np.gradient(q) > 0))) == []  # backlash is compensated


@pytest.mark.parametrize(("side", "share"), [(1, 0.85), (-1, 0.9), (1, 0.95)])
def test_a_force_that_clips_before_its_noise_is_named(rng, side: int, share: float) -> None:
    """An amplifier limits the force and the converter adds noise: no value repeats, and the motion requires more."""
    q, tau = swing(rng)
    limit = np.quantile(side * tau, share)
    (said,) = list_faulty(record(rng, q, side * np.minimum(side * tau, limit)))
    level = re.search(r"tau_a clips at ([-.\d]+) in", said)
    assert level is not None and float(level[1]) == pytest.approx(side * limit, abs=NOISE)
    assert not check_log(record(rng, q, side * np.minimum(side * tau, limit))).fit_for_use


def test_a_drive_at_its_limit_is_measured_rightly(rng) -> None:
    """A constant acceleration requires a constant force, which crowds at its extreme like a clipped one; so does friction."""
    a = np.where(T % 4 < 1, 1.0, np.where(T % 4 < 3, -1.0, 1.0))
    v = np.cumsum(a) / 250
    v -= v.mean()
    q = np.cumsum(v) / 250
    for friction in (0.0, 2.0):
        assert list_faulty(record(rng, q, 3 * a + friction * np.sign(v))) == []


def test_sound_forces_do_not_clip(rng) -> None:
    """The tops of waves hold three times as many samples as the band below them, not eight."""
    for _ in range(5):
        assert list_faulty(record(rng, *swing(rng))) == []


def test_a_joint_with_a_force_in_few_samples_does_not_clip(rng) -> None:
    """A stop pushes in a fifth of 720 samples of five joints: 110 functions of the motion say nothing about the others."""
    for _ in range(4):
        t = np.arange(0, 24, 1 / 30)
        named = {f"q_{j}": sum(0.3 * np.sin(w * t + rng.uniform(0, 6)) for w in (0.6, 1.4, 2.3, 3.5)) for j in "abcde"}
        a = np.gradient(np.gradient(named["q_a"], t), t)
        pushed = 0.15 * np.maximum(a - np.quantile(a, 0.8), 0) + 0.01 * rng.standard_normal(t.size)
        forces = {f"tau_{j}": pushed if j == "a" else rng.standard_normal(t.size) for j in "abcde"}
        read = {name: q + 1e-6 * rng.standard_normal(t.size) for name, q in named.items()}
        assert not any("clips" in w for w in list_faulty(Log(t, read | forces, "arm.csv")))
