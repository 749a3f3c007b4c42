"""Conventions of a pose file (signs, order, units, axes): readings without parameters, tried before any geometry is fitted."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
