"""What was measured for calibration: poses, distances and touches, how they are read, and how far predictions are from them."""

from .errors import (
    ErrorSize as ErrorSize,
    MeasurementNoise as MeasurementNoise,
    PoseErrors as PoseErrors,
    compute_pose_errors as compute_pose_errors,
    estimate_measurement_noise as estimate_measurement_noise,
)
from .kinds import KINDS as KINDS, TOUCHES as TOUCHES, find_directions as find_directions
from .pose_set import (
    PoseSet as PoseSet,
    join_pose_sets as join_pose_sets,
    measure_spread as measure_spread,
    number_alike as number_alike,
)
from .read import POSITION as POSITION, QUATERNION as QUATERNION, check_units as check_units, read_poses as read_poses
