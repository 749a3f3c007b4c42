"""A delay is found to the sample, at any noise, for positions and for accelerations."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from recordings import recorded, structure

from tau_dyn.modes.delay import _linear_bic, choose_delay
from tau_dyn.modes.methods import estimate_first_poles


def _found(plant, decibels: float, delay: int) -> int:
    record = recorded(plant, 2500, decibels, delay)
    choice = choose_delay(
        [record], lambda r, d: estimate_first_poles("n4sid", r, delay=d), orders=(2, 4, 6, 8), most=12
    )
    assert choice.scan and "delay" in choice.why
    return choice.delay


@pytest.mark.parametrize("decibels", [20, 40, 60])
def test_five_samples_are_found(decibels):
    """Five samples of delay are found at 20, 40 and 60 dB."""
    assert _found(structure(), decibels, 5) == 5


def test_a_strictly_proper_plant_has_none():
    """Sampling alone is no delay."""
    assert _found(structure(), 40, 0) == 0


@pytest.mark.parametrize("delay", [0, 3])
def test_accelerometers_answer_at_once(delay):
    """Accelerations answer to forces within the sample; that is no delay, and a delay on top is found."""
    assert _found(structure(accelerometers=True), 40, delay) == delay


@pytest.mark.parametrize("delay", [0, 5])
def test_with_the_true_poles_the_first_look_finds_the_delay(delay):
    """A displacement answers a force one sample later at the earliest; with its poles known the criterion is least there."""
    plant = structure()
    record = recorded(plant, 1000, 40, delay)
    assert int(np.argmin([_linear_bic(np.linalg.eigvals(plant.A), [record], d, 12) for d in range(9)])) == delay
