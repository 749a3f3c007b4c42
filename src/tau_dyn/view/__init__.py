"""The robot in the browser: sliders, playback of a log, clouds, and where a finding lives (extra `view`)."""

from tau_dyn.view.placement import Placer
from tau_dyn.view.shapes import Shape, shapes_of
from tau_dyn.view.viewer import Viewer

__all__ = ["Placer", "Shape", "Viewer", "shapes_of"]
