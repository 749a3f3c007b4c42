"""How far the tool may be from where it should be, for stated errors of actuators, rods and joints (thesis 4.3, Appendix A)."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.accuracy.default_poses import (
    choose_default_section,
    lay_default_grid,
    sample_default_motion,
)
from tau_dyn.kinematics.accuracy.error_bounds import (
    ActuatorError,
    ErrorBounds,
    RodError,
    build_isotropic_error,
    read_actuator_errors,
    read_errors_file,
)
from tau_dyn.kinematics.accuracy.error_scaling import Growth, scale_errors
from tau_dyn.kinematics.accuracy.result import AccuracyResult, Body, Measured, study_accuracy
from tau_dyn.kinematics.accuracy.section import Grid, Section, lay_grid, read_section
from tau_dyn.kinematics.accuracy.study import METHODS, Accuracy, build_device, compute_positioning_errors

__all__ = [
    "METHODS",
    "Accuracy",
    "AccuracyResult",
    "ActuatorError",
    "Body",
    "ErrorBounds",
    "Grid",
    "Growth",
    "Measured",
    "RodError",
    "Section",
    "build_device",
    "build_isotropic_error",
    "choose_default_section",
    "compute_positioning_errors",
    "lay_default_grid",
    "lay_grid",
    "read_actuator_errors",
    "read_errors_file",
    "read_section",
    "sample_default_motion",
    "scale_errors",
    "study_accuracy",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
