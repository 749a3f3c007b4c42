"""The claims of `experiments/thesis_6_3.py` on less data, and the models that it keeps."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.modes import Record, load_state_space
from tau_dyn.modes.modal import find_resonances
from tau_dyn.modes.state_space import simulate

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from thesis_6_3_parts import black_box, wristless
from thesis_6_3_parts.robots import record

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("name", "order", "side"), [("l1_reference_to_tool", 7, "r"), ("l1_kinematics_to_tool", 10, "c")]
)
def test_kept_models_simulate_a_log_of_another_seed(name: str, order: int, side: str) -> None:
    """The models for the observers have the printed orders, Table 6.4's resonances, and follow the flexible robot."""
    kept = load_state_space(ROOT / "identification" / "models" / f"{name}.yaml")
    assert kept.model.order == order and kept.inputs == (f"x_{side}", f"y_{side}")
    frequencies = np.array([m.frequency_hz for m in find_resonances(kept.model)])
    for wanted in (7.4, 11.45):
        assert np.abs(frequencies - wanted).min() < 0.05
    log = black_box.experiment("plane", 20.0, 977)
    data = record(log, list(kept.inputs), list(kept.outputs))
    error = data.y - simulate(kept.model, data)
    assert np.all(np.std(error, axis=0) < 0.1 * np.std(data.y, axis=0))


def test_two_directions_of_many_modes_give_a_crooked_damping_matrix() -> None:
    """The thesis' route on a robot whose D is symmetric and positive still returns one that is mostly skew; ours refuses."""
    model = wristless.tracker_model("xy", 4, 11)
    found = wristless.structure(model.refined)
    assert found.character.asymmetry[1] > 0.3
    assert found.ours.status != "identified"


def test_twelve_states_follow_pushes_they_have_not_seen() -> None:
    """Figure 6.13: the 12th-order model of the pushes, and 14 Hz among its modes."""
    model = wristless.tracker_model("xyz", 12, 21)
    assert model.fit.min() > 80
    assert np.abs(np.array([m.frequency_hz for m in model.refined.modes]) - 14.0).min() < 0.05
    assert all(isinstance(r, Record) for r in model.held_out)
