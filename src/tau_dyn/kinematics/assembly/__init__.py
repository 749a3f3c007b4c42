"""Assembly modes of a parallel robot at given actuated positions, and the modes between which it can move."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
