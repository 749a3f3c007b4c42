"""Kinematic calibration: from measured poses to a geometry with uncertainty, and what each model gains."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
