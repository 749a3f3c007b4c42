"""Robots: from a xacro file to a tree with loops, actuated joints and nominal parameters."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
