"""Estimation of the tool's position from the actuators and an accelerometer."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
