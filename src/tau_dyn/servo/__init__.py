"""Logs of commands and positions, without torque -> parameters through the closed loop."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
