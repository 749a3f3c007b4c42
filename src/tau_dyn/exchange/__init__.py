"""A model back in the file formats of other programs: URDF (Pinocchio, Drake, ROS), MJCF (MuJoCo), FMU (Modelica)."""

from tau_dyn.exchange.content import Exported
from tau_dyn.exchange.fmu import ExportedFmu, fmu_of
from tau_dyn.exchange.mjcf import mjcf_of
from tau_dyn.exchange.urdf import urdf_of

__all__ = ["Exported", "ExportedFmu", "fmu_of", "mjcf_of", "urdf_of"]
