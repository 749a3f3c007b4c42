"""Parallel evaluation of one function on many items: in this process, on this machine's cores or on a cluster, in order."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
