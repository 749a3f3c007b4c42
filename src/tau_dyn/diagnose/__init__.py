"""The error of a simulation, the physical cause that explains it, and how much better the model is with it."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
