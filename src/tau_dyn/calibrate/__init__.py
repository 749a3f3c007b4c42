"""Kinematic calibration: a geometry with uncertainty from measured poses, and the gain of each model."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
