"""Measurements for calibration: poses, distances and touches, their reading from files, and the errors of predictions."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
