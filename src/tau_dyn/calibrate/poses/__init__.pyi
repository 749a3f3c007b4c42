"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from .alignment import (
    CameraCorrection as CameraCorrection,
    choose_picture_pose as choose_picture_pose,
    find_camera_correction as find_camera_correction,
)
from .automation import CalibrationCampaign as CalibrationCampaign, plan_campaign as plan_campaign
from .camera import (
    Camera as Camera,
    ToolCamera as ToolCamera,
    read_camera as read_camera,
    read_tracker as read_tracker,
)
from .campaign_files import (
    format_rapid_module as format_rapid_module,
    format_tour_csv as format_tour_csv,
    read_progress as read_progress,
)
from .choice import (
    CalibrationPrediction as CalibrationPrediction,
    PoseChoice as PoseChoice,
    choose_poses as choose_poses,
    compute_doubling_gain as compute_doubling_gain,
    compute_min_poses as compute_min_poses,
)
from .devices import MeasuringDevice as MeasuringDevice, UniformDevice as UniformDevice
from .fixtures import Fixture as Fixture, FixtureSet as FixtureSet, read_fixtures as read_fixtures
from .placement import CameraPlacement as CameraPlacement, list_bones as list_bones
from .reachable import Safety as Safety
from .tour import PathCheck as PathCheck
