"""Physics that a rigid model leaves out, one file an effect."""

from __future__ import annotations

from collections.abc import Iterable

from tau_dyn.effects.effect import Effect, JointwiseEffect, Motion
from tau_dyn.effects.friction import AsymmetricFriction, SymmetricFriction, TorqueOffset
from tau_dyn.effects.reducer_coupling import ReducerCoupling
from tau_dyn.exceptions import UnknownName

EFFECTS: dict[str, type[Effect]] = {
    cls.name: cls for cls in (SymmetricFriction, AsymmetricFriction, TorqueOffset, ReducerCoupling)
}
"""Every effect by the name model files use."""

FRICTION_MODELS: dict[str, tuple[type[Effect], ...]] = {
    "rigid": (),
    "symmetric": (SymmetricFriction, TorqueOffset),
    "asymmetric": (AsymmetricFriction,),
}
"""What `identify --model` offers by name."""


def friction_model(name: str, joints: Iterable[str], units: Iterable[str]) -> tuple[Effect, ...]:
    """Return the effects that a friction model's name stands for, acting on these joints.

    Raises:
        UnknownName: The name is none of rigid, symmetric, asymmetric.
    """
    if name not in FRICTION_MODELS:
        raise UnknownName("friction model", name, FRICTION_MODELS)
    joints, units = tuple(joints), tuple(units)
    return tuple(effect(joints, units) for effect in FRICTION_MODELS[name])


__all__ = [
    "EFFECTS",
    "FRICTION_MODELS",
    "AsymmetricFriction",
    "Effect",
    "JointwiseEffect",
    "Motion",
    "ReducerCoupling",
    "SymmetricFriction",
    "TorqueOffset",
    "friction_model",
]
