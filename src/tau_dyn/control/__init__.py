"""Models in controllers: feedforward, tool observers, learning, optimal motion, lead-through; RAPID and reference files."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
