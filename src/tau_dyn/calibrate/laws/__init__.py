"""Errors of joints, drives and carts: deviations of their motion from the encoder readings."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
