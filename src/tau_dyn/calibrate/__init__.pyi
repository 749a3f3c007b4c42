"""Kinematic calibration: from measured poses to a geometry with uncertainty, and what each model gains."""

from .calibration import calibrate as calibrate, propose_pose_columns as propose_pose_columns
from .compensation import build_compensation as build_compensation
from .frames import align as align
from .geometry import Geometry as Geometry, Predicted as Predicted, constrain_parameters as constrain_parameters
from .geometry_fit import (
    CHANGE as CHANGE,
    GeometryFit as GeometryFit,
    compute_sensitivities as compute_sensitivities,
    fit_geometry_to_poses as fit_geometry_to_poses,
)
from .measured import (
    PassiveEncoders as PassiveEncoders,
    PoseErrors as PoseErrors,
    PoseSet as PoseSet,
    as_poses as as_poses,
    join_pose_sets as join_pose_sets,
    read_poses as read_poses,
)
from .model_selection import CandidateModel as CandidateModel
from .result import (
    Calibration as Calibration,
    build_device_rows as build_device_rows,
    build_frame_rows as build_frame_rows,
    build_parameter_rows as build_parameter_rows,
    list_correlated_pairs as list_correlated_pairs,
)
from .saved import load_calibration as load_calibration, save_calibration as save_calibration
