"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and where a finding lives (extra `view`)."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.view.furniture import build_furniture
from tau_dyn.view.placement import Placer
from tau_dyn.view.playback import Playback, build_playback
from tau_dyn.view.results import read_result
from tau_dyn.view.shapes import Shape
from tau_dyn.view.viewer import Viewer

__all__ = ["Placer", "Playback", "Shape", "Viewer", "build_furniture", "build_playback", "read_result"]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
