"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and where a finding lives (extra `view`)."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
