"""Kinematic calibration: from measured poses to a geometry with uncertainty, and what each model gains."""

from tau_dyn.calibrate.calibrate import calibrate
from tau_dyn.calibrate.causes import EQUATIONS as CAUSE_EQUATIONS
from tau_dyn.calibrate.geometry import Geometry, Predicted, constrain_parameters
from tau_dyn.calibrate.geometry_fit import GeometryFit, fit_geometry_to_poses
from tau_dyn.calibrate.pose_errors import PoseErrors
from tau_dyn.calibrate.pose_set import PoseSet, read_poses
from tau_dyn.calibrate.result import Calibration
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "CAUSE_EQUATIONS",
    "Calibration",
    "Geometry",
    "GeometryFit",
    "PoseErrors",
    "PoseSet",
    "Predicted",
    "calibrate",
    "constrain_parameters",
    "fit_geometry_to_poses",
    "read_poses",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
