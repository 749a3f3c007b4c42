"""Models in controllers: feedforward, tool observers, learning, optimal motion, lead-through; RAPID and reference files."""

from .drive_sharing import DriveForces as DriveForces, compute_drive_forces as compute_drive_forces
from .feedforward import Feedforward as Feedforward
from .interface.correction import (
    Correction as Correction,
    apply_correction as apply_correction,
    build_correction as build_correction,
    read_correction as read_correction,
    write_correction as write_correction,
)
from .interface.rapid import build_waypoints as build_waypoints, format_rapid_motion as format_rapid_motion
from .interface.reference import (
    CommandLimits as CommandLimits,
    build_reference as build_reference,
    check_motion as check_motion,
    count_samples_in_period as count_samples_in_period,
    read_reference as read_reference,
    write_reference as write_reference,
)
from .iterative.filters import (
    TimeShift as TimeShift,
    ZeroPhase as ZeroPhase,
    build_notch as build_notch,
    chain_filters as chain_filters,
    design_band_stop as design_band_stop,
    design_low_pass as design_low_pass,
)
from .iterative.laws import (
    LearningLaw as LearningLaw,
    NormOptimalLaw as NormOptimalLaw,
    design_robust_filter as design_robust_filter,
)
from .iterative.learned_outputs import MotorSide as MotorSide, Reference as Reference, ToolSide as ToolSide
from .iterative.lifted_system import stack_controlled_actuators as stack_controlled_actuators
from .iterative.trial_loop import (
    Convergence as Convergence,
    LearningHistory as LearningHistory,
    analyse_convergence as analyse_convergence,
    compute_frequency_condition as compute_frequency_condition,
    learn as learn,
    require_convergence as require_convergence,
)
from .lead_through.lead_through import LeadThrough as LeadThrough
from .lead_through.sensing import ForceSensor as ForceSensor
from .lead_through.settings import LeadThroughSettings as LeadThroughSettings
from .lead_through.stability import ForceLoop as ForceLoop
from .motion.limits import MotionLimits as MotionLimits
from .motion.plan import MotionPlan as MotionPlan, plan_motion as plan_motion
from .observers.complementary import ComplementaryToolObserver as ComplementaryToolObserver
from .observers.kalman import KalmanToolObserver as KalmanToolObserver
from .observers.tuning import (
    KalmanTuning as KalmanTuning,
    Whiteness as Whiteness,
    check_whiteness as check_whiteness,
    log_likelihood as log_likelihood,
    tune_complementary as tune_complementary,
    tune_kalman as tune_kalman,
)
