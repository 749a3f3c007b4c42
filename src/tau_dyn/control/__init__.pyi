"""Models in controllers: feedforward, tool observers, learning, optimal motion, lead-through; RAPID and reference files."""

from .feedforward import Feedforward as Feedforward
from .interface.check import check_motion as check_motion
from .interface.correction import (
    Correction as Correction,
    apply_correction as apply_correction,
    build_correction as build_correction,
    read_correction as read_correction,
    write_correction as write_correction,
)
from .interface.limits import CommandLimits as CommandLimits
from .interface.rapid import format_rapid_motion as format_rapid_motion
from .interface.reference import (
    build_reference as build_reference,
    read_reference as read_reference,
    write_reference as write_reference,
)
from .iterative.convergence_analysis import (
    Convergence as Convergence,
    analyse_convergence as analyse_convergence,
    compute_frequency_condition as compute_frequency_condition,
    require_convergence as require_convergence,
)
from .iterative.law import LearningLaw as LearningLaw
from .iterative.learned_outputs import MotorSide as MotorSide, ToolSide as ToolSide
from .iterative.learning import LearningHistory as LearningHistory
from .iterative.lifted_system import stack_controlled_actuators as stack_controlled_actuators
from .iterative.norm_optimal import NormOptimalLaw as NormOptimalLaw
from .iterative.reference import Reference as Reference
from .iterative.robust_filter_design import design_robust_filter as design_robust_filter
from .iterative.shift import TimeShift as TimeShift
from .iterative.trial_loop import learn as learn
from .iterative.zero_phase import (
    ZeroPhase as ZeroPhase,
    build_notch as build_notch,
    chain_filters as chain_filters,
    design_band_stop as design_band_stop,
    design_low_pass as design_low_pass,
)
from .lead_through.lead_through import LeadThrough as LeadThrough
from .lead_through.sensor import ForceSensor as ForceSensor
from .lead_through.settings import LeadThroughSettings as LeadThroughSettings
from .lead_through.stability import ForceLoop as ForceLoop
from .motion.limits import MotionLimits as MotionLimits
from .motion.plan import plan_motion as plan_motion
from .motion.result import MotionPlan as MotionPlan
from .observers.complementary import ComplementaryToolObserver as ComplementaryToolObserver
from .observers.kalman import KalmanToolObserver as KalmanToolObserver
from .observers.tuning import (
    KalmanTuning as KalmanTuning,
    log_likelihood as log_likelihood,
    tune_complementary as tune_complementary,
    tune_kalman as tune_kalman,
)
from .observers.whiteness import Whiteness as Whiteness, check_whiteness as check_whiteness
