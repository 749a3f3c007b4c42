"""A robot as a mechanism: loops closed, poses of the tool and back, forces and regressor in actuated coordinates."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
