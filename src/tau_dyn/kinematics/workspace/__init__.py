"""Where a robot's tool can be, why not elsewhere, and how well it works there."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
