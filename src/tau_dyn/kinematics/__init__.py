"""Analyses of a mechanism's kinematics: paths, workspace, accuracy, assembly modes."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
