"""Channels that stand still, die or clip are named with their time and left out; sound records raise no alarm."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import chirp

sys.path.insert(0, str(Path(__file__).parent))
from recordings import DT, HZ, binary, log_of, pulses, recorded, structure

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import ChannelFault, Log, find_channel_faults
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes import Record, find_modes
from tau_dyn.modes.record import _is_pulses, _leave_out, build_records, prepare_records

IN, OUT, N = ("force1", "force2"), ("place1", "place2"), 5000
SECONDS = np.arange(N) * DT


def _record(kind: str = "noise", *, accelerometers: bool = False, decibels: float = 46.0, seed: int = 0) -> Record:
    """Return a sound record of two modes under noise, bursts of it, or another input."""
    rng, t = np.random.default_rng(seed + 100), SECONDS  # not the noise of `recorded`
    noise = rng.normal(size=(N, 2))
    inputs = {
        "noise": noise,
        "binary": binary(N, 2, rng),
        "held noise": np.repeat(noise[: N // 20], 20, axis=0),
        "bursts": noise * (t % 6 < 2.5)[:, None],
        "pause": noise * ((t < 15) | (t > 35))[:, None],
        "free decay": np.vstack([50 * noise[:100], np.zeros((N - 100, 2))]),
        "fade": noise * (1e-2 + np.sin(2 * np.pi * t / 25) ** 4)[:, None],
        "sweep": np.column_stack([chirp(t, 1, 50, 45), chirp(t, 2, 50, 35, phi=90)]),
        "tones": np.column_stack([np.sin(2 * np.pi * 7 * t), np.cos(2 * np.pi * 3 * t)]),
        "slow tones": np.column_stack([np.sin(2 * np.pi * 0.4 * t), np.cos(2 * np.pi * 0.93 * t)]),
        "square": np.sign(np.sin(2 * np.pi * np.outer(t, [0.33, 1.1]) + 0.1)),
        "staircase": np.repeat(noise[: N // 500], 500, axis=0),
        "periodic": np.tile(noise[: N // 20], (20, 1)),
    }
    return recorded(structure(accelerometers=accelerometers), decibels=decibels, seed=seed, u=inputs[kind])


SOUND = ("noise", "binary", "held noise", "bursts", "pause", "free decay", "fade", "sweep", "tones", "slow tones", "square",
         "staircase", "periodic")  # fmt: skip


def _examine(record: Record) -> list[ChannelFault]:
    return find_channel_faults(log_of(record), record.inputs, record.outputs)


@pytest.mark.parametrize("kind", SOUND)
@pytest.mark.parametrize("accelerometers", [False, True])
def test_sound_records_raise_no_alarm(kind, accelerometers):
    """Pauses, decays, sweeps, square waves and repeated inputs are no faults, with sensor noise and in 12 bits."""
    record = _record(kind, accelerometers=accelerometers, decibels=80.0)
    noisy = replace(record, u=record.u + 3e-3 * np.random.default_rng(1).normal(size=record.u.shape))
    coarse = replace(noisy, u=np.round(noisy.u * 500), y=np.round(noisy.y / abs(noisy.y).max() * 2048))
    assert not _examine(record)
    assert not _examine(noisy)
    assert not _examine(coarse)


def test_blows_raise_no_alarm():
    """The force of a hammer rests, and its peaks repeat; a displacement in coarse steps rests before the first blow."""
    record = pulses(structure(), 600, 8, 80.0)
    assert not _examine(record)
    assert not _examine(replace(record, y=np.round(record.y / abs(record.y).max() * 2048)))


@pytest.mark.parametrize("kind", ["noise", "bursts"])
@pytest.mark.parametrize(("start", "stop"), [(3000, N), (1000, 1600)])
def test_a_sensor_that_dies_is_cut_out(kind, start, stop):
    """An output that loses all but its noise is named with its times, and records around the stretch are left."""
    record = _record(kind)
    record.y[start:stop, 0] = 0.01 * record.y[:, 0].std() * np.random.default_rng(1).normal(size=stop - start)
    (fault,) = _examine(record)
    rings = 0 if kind == "noise" else 350  # a pause, in which nothing is measured, hides the edge
    assert fault.column == "place1" and fault.warning.code == "faulty_channel"
    assert abs(fault.start - start) <= 3 + rings and abs(fault.stop - stop) <= 3 + rings
    data = prepare_records([log_of(record)], IN, OUT)
    assert fault.warning in data.warnings
    assert sum(r.n_samples for r in data.whole) == N - (fault.stop - fault.start)


def test_a_long_stretch_of_one_value_is_named_once():
    """An output that stands still for 2 s is not called dead as well."""
    record = _record()
    record.y[2000:2200, 0] = record.y[2000, 0]
    (fault,) = _examine(record)
    assert fault.warning.code == "held_channel" and (fault.start, fault.stop) == (2000, 2200)


@pytest.mark.parametrize("kind", ["noise", "bursts"])
@pytest.mark.parametrize("still", [False, True])
def test_a_force_that_is_lost_is_told_from_a_pause(kind, still):
    """A force that stands still or is quiet while the structure is driven is named; pauses between bursts are not."""
    record = _record(kind)
    rng, lost = np.random.default_rng(1), slice(1220, 1420)
    record.u[:, 0] += 3e-3 * rng.normal(size=N)
    record.u[lost, 0] = record.u[1220, 0] if still else 0.01 * rng.normal(size=200)
    (fault,) = _examine(record)
    assert fault.column == "force1" and fault.warning.code == ("held_channel" if still else "faulty_channel")
    assert abs(fault.start - 1220) < 3 and abs(fault.stop - 1420) < 3


@pytest.mark.parametrize("level", [0.7, 1.2, 2.0, 2.5])
@pytest.mark.parametrize("accelerometers", [False, True])
def test_an_output_that_clips_is_named(level, accelerometers):
    """Samples that crowd at the limit of an amplifier, in deviations of the signal, are told from the tail of a distribution."""
    record = _record(accelerometers=accelerometers)
    limit = level * record.y[:, 1].std()
    record.y[:, 1] = np.clip(record.y[:, 1], -limit, limit)
    (fault,) = _examine(record)
    assert fault.column == "place2" and not fault.cut
    assert f"clips at {-limit:.4g} and {limit:.4g}" in fault.warning


def test_an_amplifier_whose_limit_has_noise_is_named():
    """Flat tops count as clipped where the noise behind the limit leaves no two values equal."""
    record = _record()
    limit = 1.2 * record.y[:, 0].std()
    noise = 2e-3 * limit * np.random.default_rng(1).normal(size=N)
    record.y[:, 0] = np.clip(record.y[:, 0], -limit, limit) + noise
    assert [fault.column for fault in _examine(record)] == ["place1"]


def test_rest_before_the_first_force_is_no_fault():
    """An output that rests until a force acts stands still while nothing goes on but the last samples."""
    u = np.random.default_rng(1).normal(size=(N, 2))
    u[:58], u[58:60] = 0.0, 5.0
    record = recorded(structure(), decibels=80.0, u=u)
    record.y[:60] = record.y[0]
    assert not _examine(record)


def _true_modes(log: Log) -> list[str]:
    """Return the warnings of an analysis whose resonances are the structure's, within 0.5 %, and no others."""
    found = find_modes(log, IN, OUT)
    assert np.allclose([m.frequency_hz for m in found.modes], HZ, rtol=5e-3)
    return [str(w) for w in found.warnings]


def test_a_lost_force_makes_no_modes():
    """Without the stretch in which the force stands still the modes are right, and friction is not blamed."""
    record = _record()
    record.u[1500:1580, 0] = record.u[1500, 0]
    said = _true_modes(log_of(record))
    assert "force1 stands still from t = 15 to 15.79 s" in said[0]
    assert not any("nonlinear" in s for s in said)


def test_clipping_is_not_called_nonlinear_stiffness():
    """Clipping leaves powers of the response in the residual, of which the sensor is the cause; frequencies hold."""
    record = _record()
    limit = 1.2 * record.y[:, 0].std()
    record.y[:, 0] = np.clip(record.y[:, 0], -limit, limit)
    said = _true_modes(log_of(record))
    assert "place1 clips" in said[0]
    assert not any("nonlinear" in s for s in said)


def test_pulses_next_to_a_fault_are_left_out():
    """A hammer test stays one where a sensor stands still during one decay; the blows before and after serve."""
    record = pulses(structure(damping=(0.004, 0.003)), 600, 6)
    for start in (650, 1000):  # no blow is between the two
        record.y[start : start + 70, 0] = record.y[start, 0]
    data = prepare_records([log_of(record)], IN, OUT)
    assert data.kind == "impulse" and "place1 stands still" in data.warnings[0]
    assert len(data.whole) == 5


def test_a_record_without_a_sound_stretch_cannot_answer():
    """Where faults leave no stretch of 200 samples the answer names them."""
    record = _record().window(slice(0, 560))
    for start, stop in ((150, 250), (400, 460)):
        record.y[start:stop, 0] = record.y[start, 0]
    with pytest.raises(CannotAnswer, match="place1 stands still"):
        prepare_records([log_of(record)], IN, OUT)


def test_a_hammer_test_is_short_pulses_followed_by_rest():
    """Blows and their decay are one; noise, a step, a decay without a blow and a record shorter than a decay are none."""
    record = pulses(structure(), 600, 4)
    assert _is_pulses(record) and _is_pulses(record.window(slice(0, 400)))
    assert not _is_pulses(_record("noise")) and not _is_pulses(_record("square"))
    assert not _is_pulses(record.window(slice(100, 500))) and not _is_pulses(record.window(slice(0, 150)))


def test_of_a_faulty_hammer_test_stretches_without_a_blow_are_left_out():
    """Between two stuck stretches of a sensor only the end of a decay is left; it is no pulse test and is not fitted."""
    blows = pulses(structure(), 600, 4)
    log = log_of(replace(blows, u=blows.u + 0.1 * np.random.default_rng(3).normal(size=blows.u.shape)))
    faults = [
        ChannelFault("place1", a, b, True, CodedWarning("held_channel", f"place1 stands still from {a} to {b}."))
        for a, b in ((100, 140), (500, 560))
    ]
    records = build_records(log, IN, OUT)
    kept = _leave_out(records, log, faults, (), ())
    assert [r.n_samples for r in kept] == [2400 - 560]
    assert all(_is_pulses(r) for r in kept)
    noise = _record("noise")
    both = _leave_out(build_records(log_of(noise), IN, OUT), log_of(noise), faults, (), ())
    assert [r.n_samples for r in both] == [360, N - 560]
    with pytest.raises(CannotAnswer, match="No usable stretch is left"):
        _leave_out(records, log, [replace(faults[0], start=0, stop=2390)], (), ())
