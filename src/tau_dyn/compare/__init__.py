"""Comparison of two models, results or runs: their changes, and whether these exceed the uncertainty."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
