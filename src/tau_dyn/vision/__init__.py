"""Camera vision: measured poses with uncertainty from images of a patterned plate (needs OpenCV, the extra `vision`)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
