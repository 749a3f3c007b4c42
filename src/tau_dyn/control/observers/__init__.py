"""Where the tool is, from what the actuators say and an accelerometer feels."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
