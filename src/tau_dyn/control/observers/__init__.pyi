"""Where the tool is, from what the actuators say and an accelerometer feels."""

from .acceleration_check import refuse_odd_accelerations as refuse_odd_accelerations
from .camera_track import CameraTrack as CameraTrack, observe_by_camera as observe_by_camera
from .complementary import ComplementaryToolObserver as ComplementaryToolObserver
from .kalman import (
    ExtendedModel as ExtendedModel,
    KalmanToolObserver as KalmanToolObserver,
    extend_model as extend_model,
)
from .observation import (
    ObserverError as ObserverError,
    ToolObservation as ToolObservation,
    estimate_observer_error as estimate_observer_error,
    observe_tool as observe_tool,
    scale_frequencies as scale_frequencies,
)
from .tuning import (
    KalmanTuning as KalmanTuning,
    Whiteness as Whiteness,
    check_whiteness as check_whiteness,
    log_likelihood as log_likelihood,
    tune_complementary as tune_complementary,
    tune_kalman as tune_kalman,
)
