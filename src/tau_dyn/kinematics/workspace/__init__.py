"""Workspace of a robot: reachable poses of the tool, the reasons for its limits, and the dexterity within it."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
