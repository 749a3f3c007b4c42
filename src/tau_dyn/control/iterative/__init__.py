"""Iterative learning control: filters, stability checks before any motion, and learning itself."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
