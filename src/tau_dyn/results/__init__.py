"""The result protocol: the contents of any result, independent of its kind and of the renderer."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
