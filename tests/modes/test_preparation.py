"""What goes in is checked, cut and centred, and what cannot be used is refused in words."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from recordings import log_of, pulses, recorded, structure

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.modes.record import prepare_records

IN, OUT = ("force1", "force2"), ("place1", "place2")


@pytest.fixture(scope="module")
def log() -> Log:
    """A driven record as a log, its outputs far from zero."""
    return log_of(recorded(structure(), 1000), offset=50.0)


def test_the_last_third_is_held_out_around_one_origin(log):
    """The last 30 % are held out, and both parts are deviations from one operating point, which is where the plant rests."""
    data = prepare_records([log], IN, OUT)
    assert data.kind == "driven" and data.train[0].n_samples == 700 and data.holdout[0].n_samples == 300
    joined = np.vstack([data.train[0].y, data.holdout[0].y])
    raw = np.column_stack([log.channels[c] for c in OUT])
    assert_allclose(joined, raw - (raw - joined)[0])
    rest = structure().frequency_response(np.array([0.0]))[0].real @ np.mean(
        [log.channels[c][:700] for c in IN], axis=1
    )
    noise = 0.01 * raw.std(axis=0)
    assert np.all(np.abs((raw - joined)[0] - 50 - rest) < 4 * noise / np.sqrt(700) + 0.02 * noise)


def test_a_sensor_that_died_is_named(log):
    """An output that keeps one value for 0.6 s while its neighbour vibrates is named with the times; a live one is not."""
    place = log.channels["place1"].copy()
    place[400:460] = place[400]
    dead = Log(log.t, {**log.channels, "place1": place}, name="dead.csv")
    (warning,) = prepare_records([dead], IN, OUT).warnings
    assert warning.code == "held_channel" and "place1 stands still from t = 4 to 4.59 s" in warning
    assert not prepare_records([log], IN, OUT).warnings


def test_blows_are_recognised_and_cut():
    """Hammer blows are told from lasting excitation; each becomes a record of its own, and some are held out."""
    data = prepare_records([log_of(pulses(structure(), 300, 6), offset=3.0)], IN, OUT)
    assert data.kind == "impulse" and len(data.train) == 4 and len(data.holdout) == 2
    assert all(r.n_samples >= 100 for r in data.train)


def test_a_hammer_that_hits_other_places_in_other_logs_needs_no_column_of_zeros():
    """Where the hammer was elsewhere its force is zero: the same records as with a column of zeros, and it is told."""
    whole = log_of(pulses(structure(), 300, 6))
    logs, padded = [], []
    for k, (mine, other) in enumerate([IN, IN[::-1]]):
        log = replace(whole, name=f"blow{k}.csv")
        padded.append(replace(log, channels={**log.channels, other: 1e-9 * np.arange(log.n_samples)}))
        logs.append(replace(log, channels={name: x for name, x in log.channels.items() if name != other}))
        assert mine in logs[-1].channels
    data, same = prepare_records(logs, IN, OUT), prepare_records(padded, IN, OUT)
    assert data.kind == "impulse" and len(data.train) == len(same.train)
    for a, b in zip(data.train, same.train, strict=True):
        assert_allclose(a.u, b.u, atol=1e-3)
    assert any("blow0.csv has no column force2: taken as zero" in w for w in data.warnings)


def test_a_force_that_is_missing_from_a_driven_log_is_asked_for(log):
    """A shaker that another log names may have run unseen: the column is needed."""
    partial = replace(log, channels={name: x for name, x in log.channels.items() if name != "force2"})
    with raises_code("missing_column", "force2"):
        prepare_records([log, partial], IN, OUT)


@pytest.mark.parametrize(
    ("inputs", "outputs", "word"),
    [
        ((), OUT, "--inputs"),
        (IN, (), "--outputs"),
        (("torque",), OUT, "torque"),
        (("force1",), ("force1",), "twice"),
        (("force1",), ("double",), "again"),
        (("force1",), ("still",), "never changes"),
        (("force1",), ("hole",), "t = 0.5"),
    ],
)
def test_columns_that_cannot_serve_are_refused(log, inputs, outputs, word):
    """Missing, repeated, equal, constant and incomplete columns are named."""
    hole = np.array(log.channels["place1"])
    hole[50] = np.nan
    odd = log.with_channels(double=2 * np.array(log.channels["force1"]), still=np.ones(1000), hole=hole)
    with pytest.raises(InputError, match=word):
        prepare_records([odd], inputs, outputs)


def test_too_few_samples_cannot_answer(log):
    """A handful of samples is refused with the number that would do."""
    with raises_code("too_little_data"):
        prepare_records([log.window(0, 60)], IN, OUT)


def test_unlike_rates_are_refused(log):
    """Logs of different sampling rates make no model together."""
    other = Log(2 * log.t, log.channels, "slow.csv")
    with raises_code("time_stamps", "slow.csv", "50"):
        prepare_records([log, other], IN, OUT)


def test_a_jittery_clock_is_mended_and_said(log):
    """Uneven stamps are interpolated onto an even clock, with a warning."""
    t = log.t + np.random.default_rng(0).uniform(-1, 1, 1000) * 2e-3
    data = prepare_records([Log(t, log.channels, "jitter.csv")], IN, OUT)
    assert any("steps vary" in w for w in data.warnings)
