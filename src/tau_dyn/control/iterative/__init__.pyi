"""Iterative learning control: filters, stability before anything moves, and learning itself."""

from .convergence_analysis import (
    Convergence as Convergence,
    FrequencyCondition as FrequencyCondition,
    analyse_convergence as analyse_convergence,
    build_iteration_operator as build_iteration_operator,
    compute_frequency_condition as compute_frequency_condition,
    require_convergence as require_convergence,
)
from .law import LearningLaw as LearningLaw
from .learned_outputs import MotorSide as MotorSide, ToolSide as ToolSide
from .learning import LearningHistory as LearningHistory
from .lifted_system import (
    build_lifted_matrix as build_lifted_matrix,
    compute_pulse_response as compute_pulse_response,
    stack_controlled_actuators as stack_controlled_actuators,
)
from .norm_optimal import NormOptimalLaw as NormOptimalLaw
from .reference import Reference as Reference
from .robust_filter_design import design_robust_filter as design_robust_filter
from .shift import TimeShift as TimeShift
from .trial_loop import TrialPlant as TrialPlant, learn as learn
from .zero_phase import (
    ZeroPhase as ZeroPhase,
    build_notch as build_notch,
    chain_filters as chain_filters,
    design_band_stop as design_band_stop,
    design_low_pass as design_low_pass,
)
