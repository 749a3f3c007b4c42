"""Where the tool is, from what the actuators say and an accelerometer feels."""

from tau_dyn.control.observers.complementary import ComplementaryToolObserver
from tau_dyn.control.observers.extended import Extended, extended
from tau_dyn.control.observers.kalman import KalmanToolObserver
from tau_dyn.control.observers.tuning import KalmanTuning, log_likelihood, tune_complementary, tune_kalman
from tau_dyn.control.observers.whiteness import Whiteness, whiteness

__all__ = [
    "ComplementaryToolObserver",
    "Extended",
    "KalmanToolObserver",
    "KalmanTuning",
    "Whiteness",
    "extended",
    "log_likelihood",
    "tune_complementary",
    "tune_kalman",
    "whiteness",
]
