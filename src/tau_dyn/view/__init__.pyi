"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and where a finding lives (extra `view`)."""

from .playback import Playback as Playback, build_playback as build_playback
from .results import read_cloud as read_cloud, read_result as read_result
from .scene import Placer as Placer
from .shapes import Shape as Shape, build_furniture as build_furniture
from .viewer import Viewer as Viewer
