"""Motions designed for identification: the most information within the limits, and what they will tell before anything moves."""

from .criteria import CRITERIA as CRITERIA
from .design import ExcitationDesign as ExcitationDesign, design_motion as design_motion
from .noise import Noise as Noise
from .prediction import (
    InformationPrediction as InformationPrediction,
    estimate_log_noise as estimate_log_noise,
    predict as predict,
)
