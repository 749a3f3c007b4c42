"""What a result shows, whatever it is of and whoever draws it: the result protocol."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
