"""Shapers and notch filters in C: what Python computes, a sample at a time."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from tau_dyn.codegen import write_notch_source, write_shaper_source
from tau_dyn.control.vibration import Resonance, combine_shapers, design_causal_notch, design_shaper
from tau_dyn.exceptions import InputError

DT, MODES = 0.002, [Resonance(6.1, 0.03), Resonance(17.0, 0.01)]


def run(code, x: np.ndarray, size: int, first: float) -> np.ndarray:
    """Return a signal after the filter, one call a sample."""
    state, y = np.full(size, 7.0), np.zeros(len(x))
    code("start", state, ctypes.c_double(first))
    for k, value in enumerate(x):
        assert code("step", state, ctypes.c_double(value), y[k : k + 1]) == 0
    return y


@pytest.fixture
def signal(rng) -> np.ndarray:
    """Return a command that begins at rest at 0.4."""
    return 0.4 + np.cumsum(0.01 * rng.standard_normal(400))


def test_a_shaper_delays_and_adds(compiled, signal) -> None:
    """The command convolved with the impulses; before its first sample it rested there."""
    taps = combine_shapers([design_shaper("zvd", m) for m in MODES]).sampled(DT)
    code = compiled(write_shaper_source(taps, DT, "shape"), "shape")
    delays = np.round(taps.times / DT).astype(int)
    before = np.r_[np.full(delays[-1], signal[0]), signal]
    expected = sum(a * before[delays[-1] - d : len(before) - d] for a, d in zip(taps.amplitudes, delays, strict=True))
    np.testing.assert_allclose(run(code, signal, delays[-1], signal[0]), expected, rtol=0, atol=1e-13)


def test_a_notch_steps_as_in_python(compiled, signal) -> None:
    """The chain of sections on deviations from rest: a command that rests stays."""
    notch = design_causal_notch(MODES, DT)
    code = compiled(write_notch_source(notch, "notch"), "notch")
    expected = signal[0] + notch.apply(signal - signal[0])
    np.testing.assert_allclose(run(code, signal, 7, signal[0]), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["shaper", "notch"])
def test_a_number_that_is_none_changes_nothing(kind, compiled) -> None:
    """A sample that is no number is refused: output and state stay, and the next sample is answered."""
    taps = design_shaper("zv", MODES[0]).sampled(DT)
    made = (
        write_shaper_source(taps, DT, "f")
        if kind == "shaper"
        else write_notch_source(design_causal_notch(MODES, DT), "f")
    )
    code, state, y = compiled(made, "f"), np.zeros(60), np.array([7.0])
    code("start", state, ctypes.c_double(1.0))
    kept = state.copy()
    for bad in (np.nan, np.inf, 1e300):
        assert code("step", state, ctypes.c_double(bad), y) == 1 and y[0] == 7.0
        np.testing.assert_array_equal(state, kept)
    assert code("step", state, ctypes.c_double(1.0), y) == 0 and y[0] == pytest.approx(1.0)


def test_impulses_between_samples_are_not_written() -> None:
    """A delay line has whole samples only; names have to be C's."""
    with pytest.raises(InputError, match="between samples"):
        write_shaper_source(design_shaper("zv", MODES[0]), DT)
    with pytest.raises(InputError, match="cannot name a function in C"):
        write_notch_source(design_causal_notch(MODES, DT), "a-b")
