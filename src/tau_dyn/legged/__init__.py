"""Robots that walk: the motion of their base from logs, and the forces of the ground taken out of their equations."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
