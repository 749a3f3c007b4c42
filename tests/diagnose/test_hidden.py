"""Sets of `experiments/hidden_effects.py` that once went wrong, each for a reason of its own; the study itself is longer."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from hidden_effects_parts.judge import row_of
from hidden_effects_parts.sets import draw_set


@pytest.mark.parametrize(
    ("number", "seed", "cause", "twins"),
    [
        (9, 8, "transmission_error", "resolver_error"),
        (33, 10, "thermal_drift", ""),
    ],
    ids=["below_the_encoders_noise", "beside_smooth_functions_as_good"],
)
def test_what_hides_is_found_and_named(number, seed, cause, twins):
    """An encoder error of 6 um; friction that follows oil 19 s behind its thermometer."""
    row = row_of(draw_set("single", number, seed=seed))
    assert row["first"] == cause and row["first_right"] and row["spurious"] == 0
    assert row["twins"] == twins
    assert row["gain_ratio"] > 0.9


def test_what_a_loop_answers_to_its_encoders_is_no_spring():
    """Feedback through encoders of 20 um, of which every fourth sample is logged, looks like drives that yield."""
    row = row_of(draw_set("feedback", 1, seed=21))
    assert row["claims"] == 0
