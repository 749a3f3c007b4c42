"""What joints, drives and carts do beside moving as their encoders say."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
