"""Models in controllers: feedforward, tool observers, learning, optimal motion, lead-through; as code and files too."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tau_dyn.deprecated_names import get_deprecated

if TYPE_CHECKING:
    from tau_dyn.control.export_c import write_c_source
    from tau_dyn.control.export_c_kinematics import write_kinematics_source
    from tau_dyn.control.export_kinematics import KinematicsProgram, build_kinematics
    from tau_dyn.control.export_learning import write_learning_source
    from tau_dyn.control.export_model import Program, build_program
    from tau_dyn.control.export_observer import write_observer_source
    from tau_dyn.control.export_python import write_python_source
    from tau_dyn.control.feedforward import Feedforward
    from tau_dyn.control.interface import (
        CommandLimits,
        Correction,
        apply_correction,
        build_correction,
        build_reference,
        check_motion,
        format_rapid_motion,
        read_correction,
        read_reference,
        write_correction,
        write_reference,
    )
    from tau_dyn.control.iterative import (
        Convergence,
        LearningHistory,
        LearningLaw,
        MotorSide,
        NormOptimalLaw,
        Reference,
        TimeShift,
        ToolSide,
        ZeroPhase,
        analyse_convergence,
        build_notch,
        chain_filters,
        compute_frequency_condition,
        design_band_stop,
        design_low_pass,
        design_robust_filter,
        learn,
        require_convergence,
        stack_controlled_actuators,
    )
    from tau_dyn.control.lead_through import ForceLoop, ForceSensor, LeadThrough, LeadThroughSettings
    from tau_dyn.control.motion import MotionLimits, MotionPlan, plan_motion
    from tau_dyn.control.observers import (
        ComplementaryToolObserver,
        KalmanToolObserver,
        KalmanTuning,
        Whiteness,
        check_whiteness,
        log_likelihood,
        tune_complementary,
        tune_kalman,
    )

_PLACES = {
    "export_c": ("write_c_source",),
    "export_c_kinematics": ("write_kinematics_source",),
    "export_kinematics": ("KinematicsProgram", "build_kinematics"),
    "export_learning": ("write_learning_source",),
    "export_model": ("Program", "build_program"),
    "export_observer": ("write_observer_source",),
    "export_python": ("write_python_source",),
    "feedforward": ("Feedforward",),
    "interface": (
        "Correction", "CommandLimits", "check_motion", "apply_correction", "build_correction", "format_rapid_motion",
        "read_correction",
        "read_reference", "build_reference", "write_correction", "write_reference",
    ),
    "iterative": (
        "Convergence", "LearningHistory", "LearningLaw", "MotorSide", "NormOptimalLaw", "Reference", "TimeShift", "ToolSide",
        "ZeroPhase", "design_band_stop", "stack_controlled_actuators", "analyse_convergence", "build_notch", "learn",
        "design_low_pass",
        "compute_frequency_condition", "chain_filters",
        "require_convergence", "design_robust_filter",
    ),
    "lead_through": ("ForceLoop", "ForceSensor", "LeadThrough", "LeadThroughSettings"),
    "motion": ("MotionLimits", "MotionPlan", "plan_motion"),
    "observers": (
        "ComplementaryToolObserver", "KalmanToolObserver", "KalmanTuning", "Whiteness", "log_likelihood",
        "tune_complementary", "tune_kalman", "check_whiteness",
    ),
}  # fmt: skip
"""What each module offers here; it is loaded when one of its names is first used."""

_MODULE = {name: module for module, names in _PLACES.items() for name in names}

__all__ = [
    "CommandLimits",
    "ComplementaryToolObserver",
    "Convergence",
    "Correction",
    "Feedforward",
    "ForceLoop",
    "ForceSensor",
    "KalmanToolObserver",
    "KalmanTuning",
    "KinematicsProgram",
    "LeadThrough",
    "LeadThroughSettings",
    "LearningHistory",
    "LearningLaw",
    "MotionLimits",
    "MotionPlan",
    "MotorSide",
    "NormOptimalLaw",
    "Program",
    "Reference",
    "TimeShift",
    "ToolSide",
    "Whiteness",
    "ZeroPhase",
    "analyse_convergence",
    "apply_correction",
    "build_correction",
    "build_kinematics",
    "build_notch",
    "build_program",
    "build_reference",
    "chain_filters",
    "check_motion",
    "check_whiteness",
    "compute_frequency_condition",
    "design_band_stop",
    "design_low_pass",
    "design_robust_filter",
    "format_rapid_motion",
    "learn",
    "log_likelihood",
    "plan_motion",
    "read_correction",
    "read_reference",
    "require_convergence",
    "stack_controlled_actuators",
    "tune_complementary",
    "tune_kalman",
    "write_c_source",
    "write_correction",
    "write_kinematics_source",
    "write_learning_source",
    "write_observer_source",
    "write_python_source",
    "write_reference",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        return get_deprecated(__name__, name)
    found = getattr(import_module(f"{__name__}.{_MODULE[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
