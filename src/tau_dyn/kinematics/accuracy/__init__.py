"""How far the tool may be from where it should be, for stated errors of actuators, rods and joints (thesis 4.3, Appendix A)."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.kinematics.accuracy.error_bounds import (
    ActuatorError,
    ErrorBounds,
    RodError,
    actuator_errors,
    read_errors_file,
    same_in_all_directions,
)
from tau_dyn.kinematics.accuracy.error_scaling import Growth, scale_errors
from tau_dyn.kinematics.accuracy.result import AccuracyResult, Body, Measured, accuracy_study
from tau_dyn.kinematics.accuracy.section import Grid, Section, default_section, lay_grid, read_section
from tau_dyn.kinematics.accuracy.study import METHODS, Accuracy, device_of, positioning_errors

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
    "accuracy_study",
    "actuator_errors",
    "default_section",
    "device_of",
    "lay_grid",
    "positioning_errors",
    "read_errors_file",
    "read_section",
    "same_in_all_directions",
    "scale_errors",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
