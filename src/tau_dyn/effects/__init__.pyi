"""Physics that a rigid model leaves out, siblings of one family in a file."""

from .catalogue import (
    EFFECTS as EFFECTS,
    FRICTION_MODELS as FRICTION_MODELS,
    acts_on_recording as acts_on_recording,
    build_friction_model as build_friction_model,
    describe_missing_state as describe_missing_state,
    read_effects as read_effects,
    register as register,
)
from .causes import (
    CONVENTIONS as CONVENTIONS,
    GEOMETRY_CAUSES as GEOMETRY_CAUSES,
    GEOMETRY_SENTENCES as GEOMETRY_SENTENCES,
    LOOP_CAUSES as LOOP_CAUSES,
    PARAMETER_CAUSES as PARAMETER_CAUSES,
    list_causes as list_causes,
)
from .cogging import Cogging as Cogging
from .effect import (
    NO_EXPERIMENT as NO_EXPERIMENT,
    Effect as Effect,
    PlausibleRange as PlausibleRange,
    describe_ranges as describe_ranges,
    format_amount as format_amount,
    format_quantity as format_quantity,
    name_effect_in_errors as name_effect_in_errors,
    spell_unit as spell_unit,
)
from .friction import (
    AsymmetricFriction as AsymmetricFriction,
    CoulombAsymmetry as CoulombAsymmetry,
    QuadraticDrag as QuadraticDrag,
    Stribeck as Stribeck,
    SymmetricFriction as SymmetricFriction,
    TorqueOffset as TorqueOffset,
    ViscousAsymmetry as ViscousAsymmetry,
    ViscousCurvature as ViscousCurvature,
)
from .gear_losses import DirectionalEfficiency as DirectionalEfficiency, LoadFriction as LoadFriction
from .guideways import (
    GUIDE_ACROSS as GUIDE_ACROSS,
    SENSITIVITY as SENSITIVITY,
    SIDE_FORCE as SIDE_FORCE,
    CartShift as CartShift,
    CartTilt as CartTilt,
    GuidewayCompliance as GuidewayCompliance,
    GuidewayNonparallel as GuidewayNonparallel,
)
from .joint_zero import (
    SHIFTED_FORCE as SHIFTED_FORCE,
    JointZero as JointZero,
    compute_shifted_forces as compute_shifted_forces,
    interpolate_shifts as interpolate_shifts,
)
from .jointwise import (
    DisplacementEffect as DisplacementEffect,
    JointwiseDisplacement as JointwiseDisplacement,
    JointwiseEffect as JointwiseEffect,
)
from .lost_motion import Backlash as Backlash, JointCompliance as JointCompliance
from .measured_signals import (
    compute_travel as compute_travel,
    get_measured_signals as get_measured_signals,
    is_proportional as is_proportional,
    makes_force as makes_force,
)
from .motion import (
    JointMotion as JointMotion,
    JointScales as JointScales,
    LazySignals as LazySignals,
    Motion as Motion,
    Scene as Scene,
)
from .motor_electrics import (
    PULSE_WIDTH as PULSE_WIDTH,
    VOLTAGE as VOLTAGE,
    BackEmf as BackEmf,
    CircuitEffect as CircuitEffect,
    Inductance as Inductance,
    SupplySag as SupplySag,
    WindingHeat as WindingHeat,
)
from .periodic import CyclicRipple as CyclicRipple, TransmissionError as TransmissionError
from .presliding import (
    STATE as STATE,
    Bristle as Bristle,
    Hysteresis as Hysteresis,
    Lugre as Lugre,
    follow_reversal as follow_reversal,
)
from .redundant_drives import (
    REDUNDANT as REDUNDANT,
    RedundantArmature as RedundantArmature,
    build_redundant_effects as build_redundant_effects,
    read_redundant_motion as read_redundant_motion,
)
from .robot_file import (
    GRAVITY_TURN as GRAVITY_TURN,
    Armature as Armature,
    DriveGain as DriveGain,
    GravityDirection as GravityDirection,
    PinionScale as PinionScale,
    ReducerCoupling as ReducerCoupling,
)
from .static_friction import StaticFriction as StaticFriction
from .structural_compliance import StructuralCompliance as StructuralCompliance
from .timing import (
    Delay as Delay,
    DriveLag as DriveLag,
    TimingEffect as TimingEffect,
    apply_first_order_lowpass as apply_first_order_lowpass,
)
from .torque_sensing import (
    DELIVERED as DELIVERED,
    ForceReading as ForceReading,
    TorqueCrosstalk as TorqueCrosstalk,
    TorqueSaturation as TorqueSaturation,
)
from .torque_speed_limit import REPORTED as REPORTED, TorqueSpeedLimit as TorqueSpeedLimit
from .varying_friction import (
    FrictionChange as FrictionChange,
    PassiveJointFriction as PassiveJointFriction,
    PositionFriction as PositionFriction,
    ThermalDrift as ThermalDrift,
)
