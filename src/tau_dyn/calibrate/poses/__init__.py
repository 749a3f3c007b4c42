"""Which poses to measure for a calibration, how accurate it will be, and how to get there, before any is measured."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
