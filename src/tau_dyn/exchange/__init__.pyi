"""A model back in the file formats of other programs: URDF (Pinocchio, Drake, ROS), MJCF (MuJoCo), FMU (Modelica)."""

from .content import Exported as Exported
from .fmu import ExportedFmu as ExportedFmu, build_fmu as build_fmu
from .mjcf import build_mjcf as build_mjcf
from .price import describe_price as describe_price
from .urdf import build_urdf as build_urdf
