"""Expression graphs of the package's own formulas: traced from array code, evaluated on arrays or compiled from C."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
