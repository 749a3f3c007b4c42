"""Models in controllers: feedforward, tool observers, learning, optimal motion, lead-through; RAPID and reference files."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
