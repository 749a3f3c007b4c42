"""Physics that a rigid model leaves out, one file an effect."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
