"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and where a finding lives (extra `view`)."""

from tau_dyn.view.furniture import shapes_of
from tau_dyn.view.placement import Placer
from tau_dyn.view.playback import Playback, playback_of
from tau_dyn.view.results import read_result
from tau_dyn.view.shapes import Shape
from tau_dyn.view.viewer import Viewer

__all__ = ["Placer", "Playback", "Shape", "Viewer", "playback_of", "read_result", "shapes_of"]
