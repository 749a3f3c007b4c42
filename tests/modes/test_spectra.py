"""The response without a model: near the truth in open loop, and through the reference in a closed one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from recordings import in_loop, pulses, recorded, structure

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.record import Record, cut_pulses
from tau_dyn.modes.responses import estimate_empirical_response, find_tones, is_coherent


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


def _mode(hz: float, damping: float, stderr: float) -> Mode:
    return Mode(hz, damping, 1e-3, stderr, np.ones(1, complex), 0.0)


def _drive(seed: int, *, tones: float, noise: float) -> Record:
    """A structure of 7.4 and 11.5 Hz under a tone of 9.3 Hz and white noise."""
    rng, plant, t = np.random.default_rng(seed), structure(), 0.01 * np.arange(20_000)
    u = tones * np.sin(2 * np.pi * 9.3 * t)[:, None] + noise * rng.standard_normal((len(t), 2))
    return recorded(plant, u=u, seed=seed)


def test_a_tone_of_the_drive_is_no_resonance():
    """A mode without width at a tone of the input is the tone; one that rings measurably there, or lies elsewhere, is kept."""
    record = _drive(0, tones=1.0, noise=0.05)
    tone, ringing, other = _mode(9.3, 1e-6, 1e-5), _mode(9.3, 1e-3, 1e-5), _mode(9.9, 1e-6, 1e-5)
    assert find_tones((tone, ringing, other), [record]) == [tone]
    assert find_tones((tone,), [_drive(0, tones=0.0, noise=1.0)]) == []


def test_outputs_that_the_input_does_not_move_do_not_follow_it():
    """Where the record of the force is noise, coherence is that of chance; under a real force it is not."""
    record, rng = _drive(1, tones=0.0, noise=1.0), np.random.default_rng(2)
    driven = estimate_empirical_response([record], resolve=0.3)
    loose = estimate_empirical_response([replace(record, u=rng.standard_normal(record.u.shape))], resolve=0.3)
    for hz in (7.4, 11.5):
        assert is_coherent(_mode(hz, 0.02, 1e-4), driven, 2)
        assert not is_coherent(_mode(hz, 0.02, 1e-4), loose, 2)
