"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
