"""Public measured logs: which there are, and one of them in a folder with its robot file, its column map and the next command."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
