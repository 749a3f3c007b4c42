"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and where a finding lives (extra `view`)."""

from .furniture import build_furniture as build_furniture
from .placement import Placer as Placer
from .playback import Playback as Playback, build_playback as build_playback
from .results import read_cloud as read_cloud, read_result as read_result
from .shapes import Shape as Shape
from .viewer import Viewer as Viewer
