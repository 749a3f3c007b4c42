"""What was measured for calibration: poses, distances and touches, how they are read, and how far predictions are from them."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
