"""Errors of a simulation, the physical causes that explain them, and the improvement of the model by them."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
