"""Iterative learning control: filters, stability before anything moves, and learning itself."""

from tau_dyn.control.iterative.convergence_analysis import (
    Convergence,
    FrequencyCondition,
    analyse_convergence,
    compute_frequency_condition,
    iteration_operator,
    require_convergence,
)
from tau_dyn.control.iterative.law import LearningLaw
from tau_dyn.control.iterative.learn import TrialPlant, learn
from tau_dyn.control.iterative.learned_outputs import MotorSide, ToolSide
from tau_dyn.control.iterative.learning import LearningHistory
from tau_dyn.control.iterative.lifted_system import build_lifted_matrix, controlled_actuators, pulse_response
from tau_dyn.control.iterative.norm_optimal import NormOptimalLaw
from tau_dyn.control.iterative.reference import Reference
from tau_dyn.control.iterative.robust_filter import robust_filter
from tau_dyn.control.iterative.shift import TimeShift
from tau_dyn.control.iterative.zero_phase import ZeroPhase, band_stop, dip, low_pass, product
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
    "band_stop",
    "build_lifted_matrix",
    "compute_frequency_condition",
    "controlled_actuators",
    "dip",
    "iteration_operator",
    "learn",
    "low_pass",
    "product",
    "pulse_response",
    "require_convergence",
    "robust_filter",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
