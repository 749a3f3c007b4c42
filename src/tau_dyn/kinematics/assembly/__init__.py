"""Every way to put a parallel robot together at given actuated positions, and which of them it can move between."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
