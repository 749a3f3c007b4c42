"""Camera vision: images of a patterned plate in, measured poses with uncertainty out (needs OpenCV, the extra `vision`)."""

from .cameras import (
    Cameras as Cameras,
    format_cameras_text as format_cameras_text,
    read_cameras as read_cameras,
    write_cameras as write_cameras,
)
from .images import read_image as read_image
from .measure import CameraPoseTable as CameraPoseTable, measure_poses_from_images as measure_poses_from_images
from .motion import ImageTimes as ImageTimes, read_times as read_times
from .pattern import Pattern as Pattern, parse_pattern as parse_pattern
from .robot_positions import Positions as Positions, read_positions as read_positions
from .solution import solve as solve
