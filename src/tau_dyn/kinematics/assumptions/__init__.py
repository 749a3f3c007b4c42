"""Are guideways straight and parallel, does the plate keep its orientation: thesis 4.2's assumptions, on measured points."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
