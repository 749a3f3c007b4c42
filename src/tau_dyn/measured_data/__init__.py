"""Public measured logs: which there are, and one of them in a folder with its robot file, its column map and the next command."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
