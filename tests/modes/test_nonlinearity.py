"""A spring that hardens is told from dynamics that a model lacks, and from a loop."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.modes import find_modes
from tau_dyn.modes.methods import build_initial_estimator
from tau_dyn.modes.record import prepare_records
from tau_dyn.modes.residuals import compute_residuals
from tau_dyn.modes.result import Nonlinearity
from tau_dyn.modes.validation import detect_nonlinearity

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from operational_modes import record_spring


def _test(stiffening: float, seed: int, binary: bool, gain: float = 0.0, order: int = 4) -> Nonlinearity:
    log = record_spring(stiffening, gain, seed, binary)
    records = prepare_records([log], ("force",), ("place",)).train
    model = build_initial_estimator("n4sid", records)(order)
    errors = compute_residuals(model, records)
    simulated = [r.y - e for r, e in zip(records, errors, strict=True)]
    found = detect_nonlinearity(errors, simulated, [r.u for r in records], ("place",))
    assert found is not None
    return found


@pytest.mark.parametrize("binary", [False, True])
def test_a_hardening_spring_is_nonlinear(binary):
    """Duffing's spring, a tenth stiffer at rms, shows in the cube of the response."""
    found = _test(0.1, 0, binary)
    assert found.suspected and found.power == 3


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_a_linear_structure_is_not(binary, gain):
    """A linear spring raises no alarm in open or closed loop, nor does a second mode that the model lacks."""
    assert not _test(0.0, 1, binary, gain).suspected
    assert not _test(0.0, 2, binary, gain, order=2).suspected


def test_a_short_record_is_not_tested():
    """A few hundred samples cannot tell powers of the response from chance."""
    few = [np.zeros((500, 1))]
    assert detect_nonlinearity(few, few, few, ("place",)) is None


def test_the_result_warns():
    """A warning with a stable code names the output, and the JSON result holds the test."""
    found = find_modes(record_spring(0.1, 0.0, 0, False), ["force"], ["place"], order=4, delay=0)
    assert "response_nonlinear" in [getattr(w, "code", "") for w in found.warnings]
    assert found.to_dict()["nonlinearity"]["output"] == "place"
