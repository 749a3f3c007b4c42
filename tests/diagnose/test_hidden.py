"""Sets of `experiments/hidden_effects.py`, each hard for a reason of its own; the study itself is longer."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from hidden_effects_parts.drive_forms import TransmissionError
from hidden_effects_parts.friction_forms import ThermalDrift
from hidden_effects_parts.judge import row_of
from hidden_effects_parts.sets import draw_set


@pytest.mark.parametrize(
    ("number", "form", "twins"),
    [(1, TransmissionError, "resolver_error"), (0, ThermalDrift, "")],
    ids=["an_encoder_error_read_coarsely", "friction_behind_its_thermometer"],
)
def test_what_hides_is_found_and_named(number, form, twins):
    """An encoder's periodic error behind 20 um of encoder noise; friction that follows the temperature with a lag."""
    row = row_of(draw_set("single", number, seed=8, forms=(form,), strength=(300.0, 600.0)))
    assert row["first"] == form.names[0] and row["first_right"] and row["spurious"] == 0
    assert row["twins"] == twins
    assert row["gain_ratio"] > 0.9


def test_what_a_loop_answers_to_its_encoders_is_no_spring():
    """Feedback through encoders of 20 um, of which every fourth sample is logged, looks like drives that yield."""
    row = row_of(draw_set("feedback", 1, seed=21))
    assert row["claims"] == 0
