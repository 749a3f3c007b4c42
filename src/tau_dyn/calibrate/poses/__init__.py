"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from tau_dyn.calibrate.poses.automation import CalibrationCampaign, plan_campaign
from tau_dyn.calibrate.poses.choice import PoseChoice, choose_poses
from tau_dyn.calibrate.poses.devices import MeasuringDevice, UniformDevice
from tau_dyn.calibrate.poses.prediction import CalibrationPrediction
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "CalibrationCampaign",
    "CalibrationPrediction",
    "MeasuringDevice",
    "PoseChoice",
    "UniformDevice",
    "choose_poses",
    "plan_campaign",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
