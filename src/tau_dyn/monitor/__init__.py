"""A payload from two recordings, units of one type, and changes of a running robot with their time."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
