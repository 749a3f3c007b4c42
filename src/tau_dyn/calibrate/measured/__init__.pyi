"""What was measured for calibration: poses, distances and touches, how they are read, and how far predictions are from them."""

from .columns import find_pose_columns as find_pose_columns, get_unit_factor as get_unit_factor
from .encoders import (
    PassiveEncoders as PassiveEncoders,
    measured_by_joint as measured_by_joint,
    measured_by_parameter as measured_by_parameter,
    predict_measured as predict_measured,
    read_encoders_as_meant as read_encoders_as_meant,
)
from .errors import (
    ErrorSize as ErrorSize,
    MeasurementNoise as MeasurementNoise,
    PoseErrors as PoseErrors,
    compute_pose_errors as compute_pose_errors,
    estimate_measurement_noise as estimate_measurement_noise,
)
from .kinds import ENCODERS as ENCODERS, KINDS as KINDS, TOUCHES as TOUCHES, find_directions as find_directions
from .loads import LOADS as LOADS
from .pose_set import (
    PoseSet as PoseSet,
    join_pose_sets as join_pose_sets,
    measure_spread as measure_spread,
    number_alike as number_alike,
)
from .read import (
    POSITION as POSITION,
    QUATERNION as QUATERNION,
    as_poses as as_poses,
    check_units as check_units,
    read_poses as read_poses,
)
