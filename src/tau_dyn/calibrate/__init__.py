"""Kinematic calibration: from measured poses to a geometry with uncertainty, and what each model gains."""

from tau_dyn.calibrate.calibrate import calibrate
from tau_dyn.calibrate.causes import EQUATIONS as CAUSE_EQUATIONS
from tau_dyn.calibrate.errors import Errors
from tau_dyn.calibrate.fit import Fit, fit
from tau_dyn.calibrate.geometry import Geometry, Predicted, tie
from tau_dyn.calibrate.pose_set import PoseSet, read_poses
from tau_dyn.calibrate.result import Calibration

__all__ = [
    "CAUSE_EQUATIONS",
    "Calibration",
    "Errors",
    "Fit",
    "Geometry",
    "PoseSet",
    "Predicted",
    "calibrate",
    "fit",
    "read_poses",
    "tie",
]
