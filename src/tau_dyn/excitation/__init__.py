"""Motions designed for identification: most information within the limits, with the standard errors predicted beforehand."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
