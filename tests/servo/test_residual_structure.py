"""The residual of a loop: structure is reported with its variable, encoder noise is not, and colour above the floor is."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from tau_dyn.servo.records import LoopRecord
from tau_dyn.servo.residual_structure import (
    LoopResidual,
    build_residual_measurements,
    compute_noise_floor,
    find_residual_structure,
)

RATE_HZ = 50.0
N = 600  # samples of a log
NOISE_RAD = 5e-4
TURNS = np.array([0, 1, 0, 2, 0])[np.arange(N) // 75 % 5]
"""Training, validation and test blocks of 1.5 s."""


def record(rng: np.random.Generator, used: np.ndarray) -> LoopRecord:
    """Return a log of one joint that moves by 0.5 rad at 0.2 to 0.7 Hz."""
    t = np.arange(N) / RATE_HZ
    waves = [rng.uniform(0.1, 0.2) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.2, 0.45, 0.7)]
    q = np.sum(waves, axis=0)[:, None]
    goal = np.roll(q, -2, axis=0)
    return LoopRecord("log", t, q, goal, np.ones(N), np.ones(N), used, {})


def find(seed: int, hidden=lambda q: 0 * q, noise=lambda rng, size: rng.standard_normal(size)):
    """Return the structure in the residual of two logs, from a hidden dependence on position [rad] and noise."""
    rng = np.random.default_rng(seed)
    logs = [record(rng, np.ones(N, bool)) for _ in range(2)]
    residuals = [hidden(log.q) + NOISE_RAD * noise(rng, (N, 1)) for log in logs]
    parts = []
    for part in range(3):
        mine = TURNS == part
        records = [LoopRecord("log", x.t, x.q, x.command, x.supply, x.enabled, mine, {}) for x in logs]
        values = np.stack([e[mine] for e in residuals], axis=2)
        parts.append(LoopResidual(records, values))
    return find_residual_structure(("j1",), parts, np.array([NOISE_RAD]), rng)


def test_white_noise_has_no_structure():
    """Of 100 residuals of encoder noise alone at most two are reported: the level of a confirmed structure is 1e-3."""
    alarms = [any(u.status == "confirmed" for u in find(seed)) for seed in range(100)]
    assert sum(alarms) <= 2


def test_a_dependence_on_position_is_confirmed_with_its_variable():
    """A position error of 2 mrad with the square of the position is reported as a dependence on the position of its joint."""
    found = [u for u in find(1, lambda q: 2e-2 * q**2) if u.status == "confirmed"]
    assert found[0].joint == "j1" and found[0].depends_on == ("q_j1",)
    assert found[0].p_value < 1e-6
    assert 0.3 < found[0].share_of_residual_variance <= 1


def test_colour_above_the_floor_is_reported_without_a_variable():
    """Coloured noise of three times the encoder's level is no smooth function of the motion, yet it is not the encoder's."""

    def coloured(rng, size):
        return 3 * np.sqrt(1 - 0.8**2) * lfilter([1.0], [1.0, -0.8], rng.standard_normal(size), axis=0)

    found = [u for u in find(2, noise=coloured) if u.status == "confirmed"]
    assert [u.depends_on for u in found] == [()]
    assert abs(found[0].share_of_residual_variance - (1 - 1 / 9)) < 0.1


def test_a_fine_clock_counts_only_the_samples_that_were_logged(rng):
    """Of four samples of the clock one was logged: a residual of 2 mrad there is one of 2 mrad, and its noise the encoder's."""
    t, noise = np.arange(4000) * 0.005, 1e-3 * rng.normal(size=(1000, 1))
    q = np.repeat(noise, 4, axis=0)  # noise between logged samples is not measured
    used = np.arange(4000) % 4 == 0
    record = LoopRecord("log", t, q, 0 * q, np.ones(4000), np.ones(4000), used, {}, every=4)
    residual = np.full((1000, 1, 1), 2e-3)
    parts = [LoopResidual([replace(record, used=used & (k == np.arange(4000) // 400 % 3))], residual) for k in range(3)]
    (run,) = build_residual_measurements(("j",), parts).runs
    usable = np.asarray(run.usable)[:, 0]
    assert usable.mean() > 0.9
    np.testing.assert_allclose(run.y_all[usable, 0], 2e-3)
    np.testing.assert_allclose(compute_noise_floor([record]), 1e-3, rtol=0.1)
