"""Motions designed for identification: the most information within the limits, and what they will tell before anything moves."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
