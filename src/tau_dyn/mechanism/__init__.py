"""A robot as a mechanism: loops closed, poses of the tool and back, forces and regressor in actuated coordinates."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
