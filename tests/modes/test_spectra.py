"""The response without a model: near the truth in open loop, and through the reference in a closed one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from recordings import in_loop, pulses, recorded, structure

from tau_dyn.modes.record import cut_pulses
from tau_dyn.modes.responses import estimate_empirical_response


def _error(seen, plant) -> np.ndarray:
    truth = plant.frequency_response(seen.frequency)
    return np.abs(seen.response - truth).max(axis=(1, 2)) / np.abs(truth).max(axis=(1, 2))


def test_spectra_show_the_true_response():
    """At 40 dB the averaged spectra lie within 10 % of the truth away from the resonances, and coherence is near one."""
    plant = structure(damping=(0.1, 0.1))
    seen = estimate_empirical_response([recorded(plant, 20_000)])
    band = (seen.frequency > 0.5) & (seen.frequency < 15)
    assert np.median(_error(seen, plant)[band]) < 0.05
    assert np.median(seen.coherence[band]) > 0.98


def test_noise_lowers_coherence_and_only_that():
    """With as much noise as signal, coherence falls in the stop band."""
    plant = structure(damping=(0.1, 0.1))
    clean, noisy = (estimate_empirical_response([recorded(plant, 20_000, d)]) for d in (60, 0))
    assert np.nanmedian(noisy.coherence) < 0.6 < 0.95 < np.nanmedian(clean.coherence[clean.frequency < 15])


def test_the_reference_frees_from_the_loop():
    """In a closed loop with a strong disturbance the plain ratio of spectra is biased, the one through the reference is not."""
    plant = structure(damping=(0.1, 0.1))
    record, r = in_loop(plant, 20_000, gain=1.0, disturbance=1.0)
    truth = plant.frequency_response(np.array([2.0]))[0]
    off = []
    for one in (record, replace(record, reference=r)):
        seen = estimate_empirical_response([one])
        low = (seen.frequency > 1) & (seen.frequency < 3)
        off.append(np.abs(seen.response[low].mean(axis=0) - truth).max() / np.abs(truth).max())
    assert off[1] < 0.5 * off[0]


def test_a_pulse_needs_no_window():
    """One hammer blow on each input gives the response at its peaks within 5 %."""
    plant = structure(dt=0.005)
    parts = cut_pulses(pulses(plant, 2000, 2, decibels=60))
    seen = estimate_empirical_response(parts, impulses=True)
    at = [int(np.argmin(np.abs(seen.frequency - f))) for f in (7.4, 11.5)]
    assert np.max(_error(seen, plant)[at]) < 0.05
