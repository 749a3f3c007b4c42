"""A model back in the file formats of other programs: URDF (Pinocchio, Drake, ROS), MJCF (MuJoCo), FMU (Modelica)."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.exchange.content import Exported
from tau_dyn.exchange.fmu import ExportedFmu, build_fmu
from tau_dyn.exchange.mjcf import build_mjcf
from tau_dyn.exchange.urdf import build_urdf

__all__ = ["Exported", "ExportedFmu", "build_fmu", "build_mjcf", "build_urdf"]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
