"""Code from models: expressions traced from the package's own formulas, written as C, Python and FMU."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
