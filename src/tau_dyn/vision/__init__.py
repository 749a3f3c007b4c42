"""Camera vision: images of a chessboard plate in, measured poses with uncertainty out (needs OpenCV, the extra `vision`)."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.vision.cameras import Cameras, read_cameras, write_cameras
from tau_dyn.vision.measure import measure_poses_from_images
from tau_dyn.vision.pattern import Pattern, parse_pattern
from tau_dyn.vision.pose_table import CameraPoseTable, Positions, read_positions
from tau_dyn.vision.solve import solve

__all__ = [
    "CameraPoseTable",
    "Cameras",
    "Pattern",
    "Positions",
    "measure_poses_from_images",
    "parse_pattern",
    "read_cameras",
    "read_positions",
    "solve",
    "write_cameras",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
