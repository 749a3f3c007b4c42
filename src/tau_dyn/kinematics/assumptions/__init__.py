"""Are guideways straight and parallel, does the plate keep its orientation: thesis 4.2's assumptions, on measured points."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
