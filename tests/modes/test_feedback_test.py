"""Feedback is seen where it is, and not where inputs are merely coloured."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, chirp, sosfilt

sys.path.insert(0, str(Path(__file__).parent))
from recordings import binary, in_loop, recorded, structure

from tau_dyn.modes.feedback_tests import detect_feedback


def _input(kind: str, n: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    t = np.arange(n) * 0.01
    if kind == "band":
        return sosfilt(butter(4, 0.3, output="sos"), rng.normal(size=(n, 2)), axis=0)
    if kind == "sweep":
        return np.column_stack([chirp(t, 1, t[-1], 20, phi=phase) for phase in (0, 70)])
    return binary(n, 2, rng, 20) if kind == "steps" else np.tile(rng.normal(size=(n // 4, 2)), (4, 1))


@pytest.mark.parametrize("kind", ["band", "sweep", "steps", "periodic"])
def test_open_loop_is_not_taken_for_feedback(kind):
    """Coloured, swept, stepped and periodic inputs of an open loop answer to nothing."""
    for decibels in (10, 40):
        found = detect_feedback([recorded(structure(), 3000, decibels, u=_input(kind, 3000))])
        assert not found.suspected, found


def test_white_inputs_raise_no_alarm():
    """In 15 open-loop records of random binary inputs there is no alarm."""
    assert not any(detect_feedback([recorded(structure(), 1200, 20, seed=s)]).suspected for s in range(15))


def test_a_loop_is_seen():
    """A damping feedback under a disturbance is suspected, and the input named."""
    record, r = in_loop(structure(), 4000, gain=0.5, disturbance=0.4)
    found = detect_feedback([record])
    assert found.suspected and found.input in record.inputs and found.p_value < 1e-3
    assert "reference" in detect_feedback([replace(record, reference=r)]).why
