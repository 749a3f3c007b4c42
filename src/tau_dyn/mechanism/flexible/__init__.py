"""A robot whose springs yield: linearised about a pose, natural modes, linear systems to simulate."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
