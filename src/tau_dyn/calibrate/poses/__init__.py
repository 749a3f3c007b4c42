"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from tau_dyn.calibrate.poses.automation import Plan, plan_campaign
from tau_dyn.calibrate.poses.choice import PoseChoice, choose_poses
from tau_dyn.calibrate.poses.devices import Device, UniformDevice
from tau_dyn.calibrate.poses.prediction import Prediction

__all__ = ["Device", "Plan", "PoseChoice", "Prediction", "UniformDevice", "choose_poses", "plan_campaign"]
