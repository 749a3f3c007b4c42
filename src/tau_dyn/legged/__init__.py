"""Robots that walk: the motion of their base from logs, and the forces of the ground taken out of their equations."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
