"""A model back in the file formats of other programs: URDF (Pinocchio, Drake, ROS), MJCF (MuJoCo), FMU (Modelica)."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
