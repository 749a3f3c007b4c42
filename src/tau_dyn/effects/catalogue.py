"""The effects that can be named, in the contract's order, and what `identify --model` offers by name."""

from __future__ import annotations

from collections.abc import Iterable

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
from tau_dyn.effects.registry import register
from tau_dyn.effects.stribeck import Stribeck
from tau_dyn.effects.structural_compliance import StructuralCompliance
from tau_dyn.effects.thermal_drift import ThermalDrift
from tau_dyn.effects.transmission_error import TransmissionError
from tau_dyn.effects.viscous_asymmetry import ViscousAsymmetry
from tau_dyn.effects.viscous_curvature import ViscousCurvature
from tau_dyn.exceptions import UnknownName

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
