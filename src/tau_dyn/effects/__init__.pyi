"""Physics that a rigid model leaves out, siblings of one family in a file."""

from .backlash import Backlash as Backlash
from .catalogue import (
    EFFECTS as EFFECTS,
    FRICTION_MODELS as FRICTION_MODELS,
    acts_on_recording as acts_on_recording,
    build_friction_model as build_friction_model,
    describe_missing_state as describe_missing_state,
    read_effects as read_effects,
    register as register,
)
from .displacement import DisplacementEffect as DisplacementEffect, JointwiseDisplacement as JointwiseDisplacement
from .drive import Armature as Armature, DriveGain as DriveGain, ReducerCoupling as ReducerCoupling
from .effect import (
    Effect as Effect,
    PlausibleRange as PlausibleRange,
    describe_ranges as describe_ranges,
    name_effect_in_errors as name_effect_in_errors,
)
from .friction import (
    AsymmetricFriction as AsymmetricFriction,
    CoulombAsymmetry as CoulombAsymmetry,
    SymmetricFriction as SymmetricFriction,
    TorqueOffset as TorqueOffset,
    ViscousAsymmetry as ViscousAsymmetry,
)
from .geometry import GRAVITY_TURN as GRAVITY_TURN, GravityDirection as GravityDirection, PinionScale as PinionScale
from .guideways import (
    GUIDE_ACROSS as GUIDE_ACROSS,
    SENSITIVITY as SENSITIVITY,
    SIDE_FORCE as SIDE_FORCE,
    CartShift as CartShift,
    CartTilt as CartTilt,
    GuidewayCompliance as GuidewayCompliance,
    GuidewayNonparallel as GuidewayNonparallel,
)
from .hysteresis import STATE as STATE, Hysteresis as Hysteresis
from .joint_compliance import JointCompliance as JointCompliance
from .jointwise import JointwiseEffect as JointwiseEffect
from .motion import JointMotion as JointMotion, JointScales as JointScales, Motion as Motion, Scene as Scene
from .passive_joint_friction import PassiveJointFriction as PassiveJointFriction
from .periodic import CyclicRipple as CyclicRipple, TransmissionError as TransmissionError
from .position_friction import PositionFriction as PositionFriction
from .speed_friction import QuadraticDrag as QuadraticDrag, Stribeck as Stribeck, ViscousCurvature as ViscousCurvature
from .structural_compliance import StructuralCompliance as StructuralCompliance
from .timing import (
    Delay as Delay,
    DriveLag as DriveLag,
    TimingEffect as TimingEffect,
    apply_first_order_lowpass as apply_first_order_lowpass,
)
from .varying_friction import (
    FrictionChange as FrictionChange,
    LoadFriction as LoadFriction,
    ThermalDrift as ThermalDrift,
)
from .words import format_amount as format_amount, format_quantity as format_quantity, spell_unit as spell_unit
