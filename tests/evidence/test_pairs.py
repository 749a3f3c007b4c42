"""Two causes in the place of one, on the bench: a gear's two losses are friction of its load and a gain together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.effects import DirectionalEfficiency, DriveGain, Effect, LoadFriction, Motion
from tau_dyn.evidence.candidate_scan import CandidateCause, GroupTest, rescore_group
from tau_dyn.evidence.forward_step import find_rival_pairs


def carrying(motion: Motion) -> Motion:
    """Return the motion of a drive that carries up to 50 N, which depend on the place."""
    load = 10 + 40 * np.sin(6 * motion.q)
    force = 20 * motion.a + 15 * np.sign(motion.v) + 30 * motion.v + 5 + load
    return replace(motion, signals={"load": load, "reducer_torque": load, "force": force})


def candidate(effect: Effect, null_model) -> CandidateCause:
    """Return what an effect explains as a candidate."""
    fit = rescore_group(GroupTest(effect, 0.0, 1.0, len(effect.parameters), False, 1.0, np.zeros(3)), null_model)
    return CandidateCause(effect.name, (fit,), 0.0, (fit,))


@pytest.mark.parametrize(
    ("losses", "rivals"), [((0.5, 0.1), ("load_friction+drive_gain",)), ((0.5, 0.5), ())], ids=["two", "one"]
)
def test_two_losses_are_friction_and_a_gain(make, rng, losses, rivals) -> None:
    """Losses of 50 % and 10 % are friction of 30 % with a gain of 20 %; equal ones are friction alone, and no pair."""

    def hidden(motion: Motion) -> np.ndarray:
        return DirectionalEfficiency(["x"], ["N"]).columns(motion) @ np.array(losses)

    motion = carrying(make.moving(rng, ("x",), 6000, size=2.0))
    null_model = make.null_model(make.bench(rng, hidden, motions=(motion,)))
    gear, friction, gain = (
        candidate(cls(["x"], ["N"]), null_model) for cls in (DirectionalEfficiency, LoadFriction, DriveGain)
    )
    assert find_rival_pairs(gear, [gear, friction, gain], null_model) == rivals
