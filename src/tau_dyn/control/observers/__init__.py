"""Where the tool is, from what the actuators say and an accelerometer feels."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
