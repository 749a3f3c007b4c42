"""Iterative learning control: filters, stability before anything moves, and learning itself."""

from tau_dyn.control.iterative.convergence import (
    Convergence,
    Picture,
    convergence,
    iteration_operator,
    picture,
    require,
)
from tau_dyn.control.iterative.law import LearningLaw
from tau_dyn.control.iterative.learn import Plant, learn
from tau_dyn.control.iterative.learning import Learning
from tau_dyn.control.iterative.lifted import controlled_actuators, lifted, pulse_response
from tau_dyn.control.iterative.norm_optimal import NormOptimalLaw
from tau_dyn.control.iterative.reference import Reference
from tau_dyn.control.iterative.robust_filter import robust_filter
from tau_dyn.control.iterative.shift import TimeShift
from tau_dyn.control.iterative.sides import MotorSide, ToolSide
from tau_dyn.control.iterative.zero_phase import ZeroPhase, band_stop, dip, low_pass, product

__all__ = [
    "Convergence",
    "Learning",
    "LearningLaw",
    "MotorSide",
    "NormOptimalLaw",
    "Picture",
    "Plant",
    "Reference",
    "TimeShift",
    "ToolSide",
    "ZeroPhase",
    "band_stop",
    "controlled_actuators",
    "convergence",
    "dip",
    "iteration_operator",
    "learn",
    "lifted",
    "low_pass",
    "picture",
    "product",
    "pulse_response",
    "require",
    "robust_filter",
]
