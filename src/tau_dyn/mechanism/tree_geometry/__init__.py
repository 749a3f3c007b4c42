"""Dimensions of any tree as named parameters, its loops closed at other values, and how the tool moves with them."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
