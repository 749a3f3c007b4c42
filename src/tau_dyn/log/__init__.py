"""Recordings: files and column maps in, `Log` out; an even clock, filters, and checks of the recorded data."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
