"""Pulse tests show by themselves how late they are answered."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from recordings import log_of, pulses, recorded, structure

from tau_dyn.modes.delay import choose_delay, find_response_onset
from tau_dyn.modes.methods import decompose_pulse_tests, estimate_first_poles
from tau_dyn.modes.record import prepare_records

IN, OUT = ("force1", "force2"), ("place1", "place2")


@pytest.mark.parametrize(("accelerometers", "own"), [(False, 1), (True, 0)])
@pytest.mark.parametrize("delay", [0, 5])
def test_the_first_answer_bounds_the_delay(accelerometers, own, delay):
    """Positions move one sample after the delay, accelerations at once; earlier blows still ring."""
    plant = structure(accelerometers=accelerometers)
    record = recorded(plant, u=pulses(plant, 400, 6).u, decibels=50, delay=delay)
    data = prepare_records([log_of(record)], IN, OUT)
    assert find_response_onset(data.train, decompose_pulse_tests(data.train, delay=20), 20) == delay + own


def test_modes_that_no_order_holds_are_no_delay():
    """Blows on a structure of ten modes, judged with models of three: the missing ones must not become a delay."""
    hz = [7.4, 11.5, *range(14, 46, 4)]
    whole = structure(hz, [0.02] * len(hz), 0.001)
    plant = replace(whole, B=whole.B[:, :2], C=whole.C[:2], D=whole.D[:2, :2], K=whole.K[:, :2])
    record = recorded(plant, u=pulses(plant, 900, 6).u, decibels=26)
    data = prepare_records([log_of(record)], IN, OUT)
    decays = decompose_pulse_tests(data.train, delay=20)

    def chosen(least_gain: float) -> int:
        look = lambda records, d: estimate_first_poles("era", records, delay=d, decays=decays)  # noqa: E731
        return choose_delay(data.train, look, orders=(2, 4, 6), most=3, least_gain=least_gain).delay

    assert chosen(0.1) == 0 < chosen(0.0)


def test_an_idle_hammer_with_noise_does_not_start_a_pulse():
    """Two hammers of which one rests in each blow, with force noise of 1 in 600: the onset is that of the blow."""
    plant = structure(accelerometers=True)
    record = recorded(plant, u=pulses(plant, 400, 6).u, decibels=50, delay=3)
    noise = np.random.default_rng(2).normal(size=record.u.shape) * np.abs(record.u).max() / 600
    data = prepare_records([log_of(replace(record, u=record.u + noise))], IN, OUT)
    assert find_response_onset(data.train, decompose_pulse_tests(data.train, delay=20), 20) == 3


def test_a_recording_that_begins_with_the_pulse_gives_no_onset():
    """Without samples of rest before the blow nothing bounds the delay; the largest one is returned."""
    plant = structure(accelerometers=True)
    record = recorded(plant, u=pulses(plant, 400, 6).u, decibels=50)
    data = prepare_records([log_of(record)], IN, OUT)
    decays = decompose_pulse_tests(data.train, delay=20)
    cut = [replace(one, u=one.u[(k := int(np.argmax(np.abs(one.u).max(axis=1)))) :], y=one.y[k:]) for one in data.train]
    assert find_response_onset(cut, decays, 20) == 20
