"""Export of a model to file formats of other programs: URDF (Pinocchio, Drake, ROS), MJCF (MuJoCo), FMU (Modelica)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
