"""The robot in the browser: sliders, playback of a log, clouds, errors, modes, and the parts of a finding (extra `view`)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
