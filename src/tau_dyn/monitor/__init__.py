"""A payload from two recordings, units of one type, and changes of a running robot with their time."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
