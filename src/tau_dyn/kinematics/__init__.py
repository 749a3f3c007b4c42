"""What follows from a mechanism's kinematics: paths, workspace, accuracy, assembly modes."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
