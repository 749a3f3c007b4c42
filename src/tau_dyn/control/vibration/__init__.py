"""Commands that leave a resonance at rest: input shapers and notch filters."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
