"""Leaving one process: the same function on many items, here, on this machine's cores or on a cluster, in their order."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
