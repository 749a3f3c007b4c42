"""Lead-through programming with two force sensors: Dressler 2012, chapter 8."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
