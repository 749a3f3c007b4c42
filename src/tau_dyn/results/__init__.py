"""What a result shows, whatever it is of and whoever draws it: the result protocol."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
