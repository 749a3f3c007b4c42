"""How far the tool may be from where it should be, for stated errors of actuators, rods and joints (thesis 4.3, Appendix A)."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
