"""Where the tool is, from what the actuators say and an accelerometer feels."""

from .complementary import ComplementaryToolObserver as ComplementaryToolObserver
from .extended_model import ExtendedModel as ExtendedModel, extend_model as extend_model
from .kalman import KalmanToolObserver as KalmanToolObserver
from .tuning import (
    KalmanTuning as KalmanTuning,
    log_likelihood as log_likelihood,
    tune_complementary as tune_complementary,
    tune_kalman as tune_kalman,
)
from .whiteness import Whiteness as Whiteness, check_whiteness as check_whiteness
