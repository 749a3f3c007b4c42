"""Iterative learning control: filters, stability before anything moves, and learning itself."""

from tau_dyn.control.iterative.convergence_analysis import (
    Convergence,
    FrequencyCondition,
    analyse_convergence,
    build_iteration_operator,
    compute_frequency_condition,
    require_convergence,
)
from tau_dyn.control.iterative.law import LearningLaw
from tau_dyn.control.iterative.learn import TrialPlant, learn
from tau_dyn.control.iterative.learned_outputs import MotorSide, ToolSide
from tau_dyn.control.iterative.learning import LearningHistory
from tau_dyn.control.iterative.lifted_system import (
    build_lifted_matrix,
    compute_pulse_response,
    stack_controlled_actuators,
)
from tau_dyn.control.iterative.norm_optimal import NormOptimalLaw
from tau_dyn.control.iterative.reference import Reference
from tau_dyn.control.iterative.robust_filter_design import design_robust_filter
from tau_dyn.control.iterative.shift import TimeShift
from tau_dyn.control.iterative.zero_phase import (
    ZeroPhase,
    build_notch,
    chain_filters,
    design_band_stop,
    design_low_pass,
)
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "Convergence",
    "FrequencyCondition",
    "LearningHistory",
    "LearningLaw",
    "MotorSide",
    "NormOptimalLaw",
    "Reference",
    "TimeShift",
    "ToolSide",
    "TrialPlant",
    "ZeroPhase",
    "analyse_convergence",
    "build_iteration_operator",
    "build_lifted_matrix",
    "build_notch",
    "chain_filters",
    "compute_frequency_condition",
    "compute_pulse_response",
    "design_band_stop",
    "design_low_pass",
    "design_robust_filter",
    "learn",
    "require_convergence",
    "stack_controlled_actuators",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
