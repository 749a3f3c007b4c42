"""Physics that a rigid model leaves out, one file an effect."""

from .armature import Armature as Armature
from .backlash import Backlash as Backlash
from .cart_shift import SENSITIVITY as SENSITIVITY, CartShift as CartShift
from .cart_tilt import CartTilt as CartTilt
from .catalogue import (
    EFFECTS as EFFECTS,
    FRICTION_MODELS as FRICTION_MODELS,
    build_friction_model as build_friction_model,
    register as register,
)
from .coulomb_asymmetry import CoulombAsymmetry as CoulombAsymmetry
from .cyclic_ripple import CyclicRipple as CyclicRipple
from .delay import Delay as Delay
from .displacement import DisplacementEffect as DisplacementEffect
from .drive_gain import DriveGain as DriveGain
from .drive_lag import DriveLag as DriveLag, apply_first_order_lowpass as apply_first_order_lowpass
from .effect import Effect as Effect, name_effect_in_errors as name_effect_in_errors
from .friction import (
    AsymmetricFriction as AsymmetricFriction,
    SymmetricFriction as SymmetricFriction,
    TorqueOffset as TorqueOffset,
)
from .friction_change import FrictionChange as FrictionChange
from .gravity_direction import GRAVITY_TURN as GRAVITY_TURN, GravityDirection as GravityDirection
from .guideway_compliance import SIDE_FORCE as SIDE_FORCE, GuidewayCompliance as GuidewayCompliance
from .guideway_nonparallel import GUIDE_ACROSS as GUIDE_ACROSS, GuidewayNonparallel as GuidewayNonparallel
from .hysteresis import STATE as STATE, Hysteresis as Hysteresis
from .joint_compliance import JointCompliance as JointCompliance
from .jointwise import JointwiseEffect as JointwiseEffect
from .jointwise_displacement import JointwiseDisplacement as JointwiseDisplacement
from .load_friction import LoadFriction as LoadFriction
from .motion import JointMotion as JointMotion, Motion as Motion
from .passive_joint_friction import PassiveJointFriction as PassiveJointFriction
from .pinion_scale import PinionScale as PinionScale
from .plausible import JointScales as JointScales, PlausibleRange as PlausibleRange, describe_ranges as describe_ranges
from .position_friction import PositionFriction as PositionFriction
from .quadratic_drag import QuadraticDrag as QuadraticDrag
from .read import read_effects as read_effects
from .reducer_coupling import ReducerCoupling as ReducerCoupling
from .scene import Scene as Scene
from .state import acts_on_recording as acts_on_recording, describe_missing_state as describe_missing_state
from .stribeck import Stribeck as Stribeck
from .structural_compliance import StructuralCompliance as StructuralCompliance
from .thermal_drift import ThermalDrift as ThermalDrift
from .timing import TimingEffect as TimingEffect
from .transmission_error import TransmissionError as TransmissionError
from .viscous_asymmetry import ViscousAsymmetry as ViscousAsymmetry
from .viscous_curvature import ViscousCurvature as ViscousCurvature
from .words import format_amount as format_amount, format_quantity as format_quantity, spell_unit as spell_unit
