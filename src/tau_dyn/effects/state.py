"""Which effects a single state `(q, v, a)` determines, and why the others need more: a recording, a history, a signal.

A controller and a motion's limits know states only. An effect that distorts the recording (a late force, an encoder beside its
load) leaves the robot's force at a state as it is; friction that follows a temperature, or that remembers its last reversal,
has a force there but needs to be told.
"""

from __future__ import annotations

from collections.abc import Collection

from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.effects.effect import Effect
from tau_dyn.effects.hysteresis import Hysteresis


def acts_on_recording(effect: Effect) -> bool:
    """Return whether an effect only distorts what is recorded, so that the robot moves as it would without it."""
    return effect.measured or (isinstance(effect, DisplacementEffect) and not isinstance(effect, Hysteresis))


def describe_missing_state(effect: Effect, given: Collection[str]) -> str:
    """Return why a state and the signals given do not determine an effect's force; empty where they do."""
    if acts_on_recording(effect):
        return "it distorts what is recorded and leaves the robot's force as it is"
    missing = [name for name in effect.needs if name not in given]
    return f"it feels {missing[0]}, which a single state does not give" if missing else ""
