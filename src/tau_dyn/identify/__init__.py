"""Torque logs -> masses and friction."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.identify.choices import Choices
from tau_dyn.identify.errors import ForceErrors, build_force_errors
from tau_dyn.identify.identify import build_model, identify
from tau_dyn.identify.log_integrity import check_against_robot, check_integrity, is_diagnosis_invalid
from tau_dyn.identify.preparation import Preparation, choose_preparation
from tau_dyn.identify.regression import build_regression
from tau_dyn.identify.result import Identification
from tau_dyn.identify.streaming import BlockExecutor

__all__ = [
    "BlockExecutor",
    "Choices",
    "ForceErrors",
    "Identification",
    "Preparation",
    "build_force_errors",
    "build_model",
    "build_regression",
    "check_against_robot",
    "check_integrity",
    "choose_preparation",
    "identify",
    "is_diagnosis_invalid",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
