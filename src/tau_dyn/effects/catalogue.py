"""Which effects exist: those of this package in the contract's order, and those that a program adds from outside by `register`.

    @tau_dyn.effects.register
    class Bellows(JointwiseEffect): ...

From then on model files, effect files, `simulate` and `diagnose` know it by its name, as they know ours. Nothing is searched for
and no file is run by itself: a program that loads a model with an effect of its own imports the module that registers it first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from inspect import isabstract
from typing import TypeVar

from tau_dyn.effects.armature import Armature
from tau_dyn.effects.backlash import Backlash
from tau_dyn.effects.cart_tilt import CartTilt
from tau_dyn.effects.coulomb_asymmetry import CoulombAsymmetry
from tau_dyn.effects.cyclic_ripple import CyclicRipple
from tau_dyn.effects.delay import Delay
from tau_dyn.effects.drive_gain import DriveGain
from tau_dyn.effects.drive_lag import DriveLag
from tau_dyn.effects.effect import Effect
from tau_dyn.effects.friction import AsymmetricFriction, SymmetricFriction, TorqueOffset
from tau_dyn.effects.friction_change import FrictionChange
from tau_dyn.effects.gravity_direction import GravityDirection
from tau_dyn.effects.guideway_compliance import GuidewayCompliance
from tau_dyn.effects.guideway_nonparallel import GuidewayNonparallel
from tau_dyn.effects.hysteresis import Hysteresis
from tau_dyn.effects.joint_compliance import JointCompliance
from tau_dyn.effects.load_friction import LoadFriction
from tau_dyn.effects.passive_joint_friction import PassiveJointFriction
from tau_dyn.effects.pinion_scale import PinionScale
from tau_dyn.effects.position_friction import PositionFriction
from tau_dyn.effects.quadratic_drag import QuadraticDrag
from tau_dyn.effects.reducer_coupling import ReducerCoupling
from tau_dyn.effects.stribeck import Stribeck
from tau_dyn.effects.structural_compliance import StructuralCompliance
from tau_dyn.effects.thermal_drift import ThermalDrift
from tau_dyn.effects.transmission_error import TransmissionError
from tau_dyn.effects.viscous_asymmetry import ViscousAsymmetry
from tau_dyn.effects.viscous_curvature import ViscousCurvature
from tau_dyn.exceptions import InputError, UnknownName

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by the name model files use, causes in the order in which they are listed."""

_SAID_BY_A_CAUSE = ("equation", "reveals")
E = TypeVar("E", bound=type[Effect])


def register(effect: E) -> E:
    """Make an effect known by its name, and return it, so that it serves as a decorator.

    A class of your own may come again under its name, as it does where a notebook's cell is run twice; the last one counts.

    Raises:
        InputError: It is no effect that can be built, its name is no name or another effect's, or it is a cause and does not say
            by which equation it acts and which motion reveals it.
    """
    name = getattr(effect, "name", None)
    if not (isinstance(effect, type) and issubclass(effect, Effect)) or isabstract(effect):
        raise InputError(
            "invalid_value",
            f"{effect!r} is no effect: derive it from Effect or JointwiseEffect, with all that they leave open",
        )
    if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise InputError(
            "invalid_value", f"effect {effect.__name__} needs a name of small letters, digits and _, not {name!r}"
        )
    known = EFFECTS.get(name)
    if known is not None and not _again(known, effect):
        raise InputError(
            "unsupported",
            f"there is an effect '{name}' already, {known.__module__}.{known.__qualname__}; name yours otherwise",
        )
    missing = [key for key in _SAID_BY_A_CAUSE if effect.cause and not getattr(effect, key, "")]
    if missing:
        raise InputError(
            "invalid_value", f"effect {name} is a cause and has no {missing[0]}, which the answer tells people"
        )
    EFFECTS[name] = effect
    return effect


def _again(known: type[Effect], effect: type[Effect]) -> bool:
    """Whether this is a class from outside once more, such as a notebook's cell that is run again."""
    ours = known.__module__.startswith("tau_dyn.")
    return known is effect or (known.__qualname__ == effect.__qualname__ and not ours)


_IN_ORDER: tuple[type[Effect], ...] = (
    SymmetricFriction,
    AsymmetricFriction,
    # causes, in the contract's order
    CoulombAsymmetry,
    ViscousAsymmetry,
    Stribeck,
    LoadFriction,
    PositionFriction,
    ThermalDrift,
    PassiveJointFriction,
    QuadraticDrag,
    ViscousCurvature,
    TorqueOffset,
    DriveGain,
    CyclicRipple,
    Delay,
    DriveLag,
    Backlash,
    Hysteresis,
    TransmissionError,
    ReducerCoupling,
    PinionScale,
    GravityDirection,
    Armature,
    StructuralCompliance,
    JointCompliance,
    GuidewayNonparallel,
    GuidewayCompliance,
    CartTilt,
    FrictionChange,
)

for _effect in _IN_ORDER:
    register(_effect)

FRICTION_MODELS: dict[str, tuple[type[Effect], ...]] = {
    "rigid": (),
    "symmetric": (SymmetricFriction, TorqueOffset),
    "asymmetric": (AsymmetricFriction,),
}
"""What `identify --model` offers by name."""


def build_friction_model(name: str, joints: Iterable[str], units: Iterable[str]) -> tuple[Effect, ...]:
    """Return the effects that a friction model's name stands for, acting on these joints.

    Raises:
        UnknownName: The name is none of rigid, symmetric, asymmetric.
    """
    if name not in FRICTION_MODELS:
        raise UnknownName("friction model", name, FRICTION_MODELS)
    joints, units = tuple(joints), tuple(units)
    return tuple(effect(joints, units) for effect in FRICTION_MODELS[name])
