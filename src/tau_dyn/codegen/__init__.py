"""Code from models: expressions traced from the package's own formulas, written as C, Python and FMU."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
