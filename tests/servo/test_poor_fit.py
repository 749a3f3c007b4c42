"""A simulation is compared with the encoder's noise: a law that is wrong leaves more than that, and `identify` reports it."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.evidence import describe_poor_simulations, find_poor_simulations
from tau_dyn.message_codes import get_code
from tau_dyn.servo import diagnose_loop, identify_loop

from .arms import build_arm, build_law, build_truth, record


@pytest.mark.parametrize(("share", "poor"), [(1.0, False), (1.4, True)])
def test_a_gain_that_is_wrong_by_two_fifths_is_a_poor_fit(share: float, poor: bool) -> None:
    """Bodies and friction absorb part of a wrong gain and leave four times the noise; the true gain leaves the noise."""
    arm = build_arm(1)
    log = record(arm, build_truth(arm), build_law(arm, 2.65), 1, duration=20.0)
    found = identify_loop(arm, log, law=build_law(arm, share * 2.65))
    assert bool(found.train.rms_per_joint[0] > 2e-3) is poor
    assert [fit.joint for fit in found.poor_fits] == (["j1"] if poor else [])
    assert ("poor_fit" in [get_code(warning) for warning in found.warnings]) is poor


def test_a_simulation_as_good_as_the_encoder_is_no_poor_fit() -> None:
    """Neither a residual near the noise counts, nor one that is a small part of the distance between robot and command."""
    noise, distance = np.full(3, 5e-4), np.full(3, 0.1)
    (found,) = find_poor_simulations(("a", "b", "c"), np.array([7e-4, 3e-3, 6e-4]), noise, distance, 1000)
    assert found.joint == "b" and found.missed_rms == pytest.approx(np.sqrt(9e-6 - 25e-8)) and found.p_value < 1e-3
    (warning,) = describe_poor_simulations([found], {"b": "rad"})
    assert "b (3 mrad beyond 0.5 mrad)" in warning
    assert find_poor_simulations(("a",), np.array([3e-3]), noise[:1], np.ones(1), 1000) == ()


def test_values_of_a_diagnosed_loop_have_standard_errors() -> None:
    """With the gain corrected, friction returns within its error; without it the error of the gain is in the friction."""
    arm = build_arm(1)
    logs = [record(arm, build_truth(arm), build_law(arm, 2.65), seed, duration=20.0) for seed in (1, 2)]
    found = diagnose_loop(arm, logs, law=build_law(arm, 2 * 2.65))
    assert [f.cause for f in found.findings if f.status == "confirmed"] == ["gain_error"]
    before, after = (model.parameters["j1.coulomb"] for model in (found.model, found.extended_model))
    assert after.stderr is not None and abs(after.value - 0.06) < 3 * after.stderr
    assert before.stderr is not None and abs(before.value - 0.06) > 10 * after.stderr
