"""Public names that have been renamed: the former name stays importable for one release and warns."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

DEPRECATED: dict[str, dict[str, str]] = {
    "tau_dyn.calibrate": {
        "Errors": "PoseErrors",
        "Fit": "GeometryFit",
        "fit": "fit_geometry_to_poses",
        "tie": "constrain_parameters",
    },
    "tau_dyn.control": {
        "Learning": "LearningHistory",
        "convergence": "analyse_convergence",
        "corrected": "apply_correction",
        "correction_of": "build_correction",
        "picture": "compute_frequency_condition",
        "require": "require_convergence",
    },
    "tau_dyn.control.interface": {
        "PERIOD": "DEFAULT_PERIOD_S",
        "corrected": "apply_correction",
        "correction_of": "build_correction",
    },
    "tau_dyn.control.iterative": {
        "Learning": "LearningHistory",
        "Picture": "FrequencyCondition",
        "Plant": "TrialPlant",
        "convergence": "analyse_convergence",
        "lifted": "build_lifted_matrix",
        "picture": "compute_frequency_condition",
        "require": "require_convergence",
    },
    "tau_dyn.control.observers": {
        "Extended": "ExtendedModel",
        "extended": "extend_model",
    },
    "tau_dyn.diagnose": {
        "Errors": "OutputErrors",
    },
    "tau_dyn.estimate": {
        "Body": "InertialBody",
        "DETERMINED": "MAX_RELATIVE_STDERR",
        "Everything": "StreamedData",
        "Physics": "PhysicalConstraints",
        "Totals": "SufficientStatistics",
    },
    "tau_dyn.identify": {
        "Engine": "BlockExecutor",
    },
    "tau_dyn.kinematics": {
        "Followed": "FollowedPath",
        "Forward": "ForwardResult",
        "Inverse": "InverseResult",
        "follow": "follow_path",
    },
    "tau_dyn.kinematics.accuracy": {
        "Errors": "ErrorBounds",
        "grow": "scale_errors",
    },
    "tau_dyn.kinematics.workspace": {
        "Demands": "PoseRequirements",
    },
    "tau_dyn.log": {
        "Finding": "CheckFinding",
        "Stretch": "EvenSegment",
        "reversals": "find_reversals",
        "stretches": "split_even_segments",
        "unbroken": "find_true_runs",
    },
}
"""Package -> former name -> name."""


def get_deprecated(package: str, name: str) -> Any:
    """Return what a package's former name stands for, with a `DeprecationWarning`."""
    new = DEPRECATED.get(package, {}).get(name)
    if new is None:
        raise AttributeError(f"module '{package}' has no attribute '{name}'")
    warnings.warn(f"{package}.{name} is deprecated, use {package}.{new}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(package), new)
