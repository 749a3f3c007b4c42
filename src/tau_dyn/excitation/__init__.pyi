"""Motions designed for identification: the most information within the limits, and what they will tell before anything moves."""

from .design import ExcitationDesign as ExcitationDesign, design_motion as design_motion
from .information import (
    CRITERIA as CRITERIA,
    InformationPrediction as InformationPrediction,
    Noise as Noise,
    estimate_log_noise as estimate_log_noise,
    predict as predict,
    predict_ideal_log as predict_ideal_log,
)
from .search import choose_by_exchange as choose_by_exchange
