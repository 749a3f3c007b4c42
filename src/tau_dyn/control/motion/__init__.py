"""Motions in the shortest time or with less effort, within the limits of the drives (needs casadi: `tau_dyn[motion]`)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
