"""Motions designed for identification: the most information within the limits, and what they will tell before anything moves."""

from tau_dyn.excitation.criteria import CRITERIA
from tau_dyn.excitation.design import Design, design_motion
from tau_dyn.excitation.noise import Noise
from tau_dyn.excitation.predict import Prediction, noise_of_log, predict

__all__ = ["CRITERIA", "Design", "Noise", "Prediction", "design_motion", "noise_of_log", "predict"]
