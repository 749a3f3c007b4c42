"""Verdicts from one body of evidence: hypotheses, null model, selection, confirmation, gain, detection limits, structure."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
