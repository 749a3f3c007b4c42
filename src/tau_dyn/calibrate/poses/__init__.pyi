"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from .automation import CalibrationCampaign as CalibrationCampaign, plan_campaign as plan_campaign
from .choice import PoseChoice as PoseChoice, choose_poses as choose_poses
from .device_file import read_camera as read_camera, read_tracker as read_tracker
from .devices import MeasuringDevice as MeasuringDevice, UniformDevice as UniformDevice
from .path_check import PathCheck as PathCheck
from .pose_count import compute_doubling_gain as compute_doubling_gain, compute_min_poses as compute_min_poses
from .prediction import CalibrationPrediction as CalibrationPrediction
from .progress_file import read_progress as read_progress
from .rapid import format_rapid_module as format_rapid_module, format_tour_csv as format_tour_csv
from .reachable import Safety as Safety
