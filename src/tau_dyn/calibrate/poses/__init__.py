"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
