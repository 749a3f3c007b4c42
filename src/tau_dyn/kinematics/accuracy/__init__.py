"""Positioning errors of the tool for given errors of actuators, rods and joints (thesis 4.3, Appendix A)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
