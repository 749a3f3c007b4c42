"""Dimensions of any tree as named parameters, its loops closed at other values, and how the tool moves with them."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
