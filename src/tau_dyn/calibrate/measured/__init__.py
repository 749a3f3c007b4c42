"""What was measured for calibration: poses, distances and touches, how they are read, and how far predictions are from them."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
