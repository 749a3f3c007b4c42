"""Kinematic calibration: from measured poses to a geometry with uncertainty, and what each model gains."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
