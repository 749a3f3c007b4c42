"""Two models, results or runs beside each other: what changed, and whether by more than their uncertainty."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
