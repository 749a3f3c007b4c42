"""Where the tool is, from what the actuators say and an accelerometer feels."""

from tau_dyn.control.observers.complementary import ComplementaryToolObserver
from tau_dyn.control.observers.extended_model import ExtendedModel, extend_model
from tau_dyn.control.observers.kalman import KalmanToolObserver
from tau_dyn.control.observers.tuning import KalmanTuning, log_likelihood, tune_complementary, tune_kalman
from tau_dyn.control.observers.whiteness import Whiteness, check_whiteness
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "ComplementaryToolObserver",
    "ExtendedModel",
    "KalmanToolObserver",
    "KalmanTuning",
    "Whiteness",
    "check_whiteness",
    "extend_model",
    "log_likelihood",
    "tune_complementary",
    "tune_kalman",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
