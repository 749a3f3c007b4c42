"""Recordings: files and column maps in, `Log` out; an even clock, filters, and a judgement of what was recorded."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
