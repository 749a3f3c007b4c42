"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
