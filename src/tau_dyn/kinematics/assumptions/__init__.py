"""Checks of assumptions on measured points (thesis 4.2): straight and parallel guideways, constant orientation of the plate."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
