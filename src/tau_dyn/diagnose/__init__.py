"""The error of a simulation, the physical cause that explains it, and how much better the model is with it."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
