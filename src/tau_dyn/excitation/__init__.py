"""Motions designed for identification: the most information within the limits, and what they will tell before anything moves."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.excitation.criteria import CRITERIA
from tau_dyn.excitation.design import ExcitationDesign, design_motion
from tau_dyn.excitation.noise import Noise
from tau_dyn.excitation.predict import InformationPrediction, estimate_log_noise, predict

__all__ = [
    "CRITERIA",
    "ExcitationDesign",
    "InformationPrediction",
    "Noise",
    "design_motion",
    "estimate_log_noise",
    "predict",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
