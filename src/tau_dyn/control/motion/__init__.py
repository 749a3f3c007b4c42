"""Motions in the shortest time or with less effort, within the limits of the drives (needs casadi: `tau_dyn[motion]`)."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
