"""How a pose file counts, orders and turns its numbers: readings without parameters, tried before any geometry is fitted."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
