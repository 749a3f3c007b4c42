"""A robot whose springs yield: linearised about a pose, natural modes, linear systems to simulate."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
