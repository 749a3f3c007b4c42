"""A logger that asks a device at scattered times: the device's even clock is found in the motion, and nowhere else."""

import numpy as np
import pytest
from numpy.random import default_rng

from tau_dyn.log import Log
from tau_dyn.log.data_integrity import repair_log
from tau_dyn.log.update_rate import find_device_clock

TICK = 1e-3
JOINTS = ("a", "b", "c")


def move(t: np.ndarray) -> np.ndarray:
    """Return positions of three joints (N, 3) [rad] at times (N,)."""
    return np.stack([np.sin(2 * t), 0.6 * np.sin(3 * t + 1), 0.4 * np.cos(2.6 * t)], axis=1)


def poll(seconds: float = 12.0, scatter: float = 0.3, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps of a logger that asks about once a tick, and the ticks that it is given."""
    rng = default_rng(seed)
    n = int(seconds / TICK)
    asked = TICK * np.cumsum(1 + rng.uniform(-scatter, scatter, n))
    return asked, np.floor(asked / TICK).astype(int)


def build_log(stamps: np.ndarray, true: np.ndarray, noise: float = 2e-6) -> Log:
    """Return a log of positions at true times under stamps, with forces."""
    q = move(true) + noise * default_rng(2).normal(size=(len(true), 3))
    tau = 3 * move(true) + 0.02 * default_rng(3).normal(size=(len(true), 3))
    channels = {f"q_{j}": q[:, k] for k, j in enumerate(JOINTS)} | {f"tau_{j}": tau[:, k] for k, j in enumerate(JOINTS)}
    return Log(stamps, channels, "polled.csv")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_polled_device_gets_its_even_clock(seed: int) -> None:
    stamps, ticks = poll(seed=seed)
    new = np.diff(ticks, prepend=-1) > 0
    log = build_log(stamps[new], TICK * ticks[new])
    found = find_device_clock(log.t, log.joint("q", JOINTS))
    assert found is not None
    assert found.tick_s == pytest.approx(TICK, rel=1e-4)
    wrong = np.round((found.t - TICK * ticks[new]) / TICK - np.median((found.t - TICK * ticks[new]) / TICK))
    assert np.mean(wrong == 0) > 0.99, "rows have their own ticks; the first and last few have only stamps"
    assert np.max(np.abs(wrong)) <= 1


def test_repair_uses_the_clock_and_says_so() -> None:
    stamps, ticks = poll()
    new = np.diff(ticks, prepend=-1) > 0
    repair = repair_log(build_log(stamps[new], TICK * ticks[new]), JOINTS)
    assert [w.code for w in repair.warnings] == ["stamps_scatter"]
    steps = np.diff(repair.log.t) / TICK
    assert np.allclose(steps, np.round(steps), atol=1e-6)


def test_measurement_logged_twice_counts_once() -> None:
    stamps, ticks = poll()
    log = build_log(stamps, TICK * ticks)
    q = move(TICK * ticks) + 2e-6 * default_rng(5).normal(size=(ticks[-1] + 1, 3))[ticks]
    log = log.with_channels(**{f"q_{j}": q[:, k] for k, j in enumerate(JOINTS)})  # forces differ from row to row
    repair = repair_log(log, JOINTS)
    assert repair.log.n_samples <= len(np.unique(ticks)) + 12, "the first and last six rows have only stamps"


@pytest.mark.parametrize("uneven", ["true_times", "good_stamps", "one_slow_joint"])
def test_other_clocks_are_kept(uneven: str) -> None:
    rng = default_rng(4)
    n = 12000
    if uneven == "true_times":
        t = TICK * np.cumsum(1 + rng.uniform(-0.4, 0.4, n))
        stamps, q = t, move(t) + 2e-6 * rng.normal(size=(n, 3))
    elif uneven == "good_stamps":
        t = TICK * np.cumsum(rng.choice([1, 2], n))
        stamps, q = t + 1e-5 * rng.uniform(size=n), move(t) + 2e-6 * rng.normal(size=(n, 3))
    else:
        t = TICK * np.arange(n)
        stamps = t + 0.3 * TICK * rng.uniform(-1, 1, n)
        q = (0.01 * np.sin(0.5 * t) + 1e-4 * rng.normal(size=n))[:, None]
    assert find_device_clock(stamps, q) is None
