"""Camera vision: images of a chessboard plate in, measured poses with uncertainty out (needs OpenCV, the extra `vision`)."""

from tau_dyn.vision.cameras import Cameras, read_cameras, write_cameras
from tau_dyn.vision.measure import poses_from_images
from tau_dyn.vision.pattern import Pattern, parse_pattern
from tau_dyn.vision.pose_table import PoseTable, Positions, read_positions
from tau_dyn.vision.solve import solve

__all__ = [
    "Cameras",
    "Pattern",
    "PoseTable",
    "Positions",
    "parse_pattern",
    "poses_from_images",
    "read_cameras",
    "read_positions",
    "solve",
    "write_cameras",
]
