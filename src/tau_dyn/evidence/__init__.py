"""Statistical judgement of hypotheses: hypotheses, null model, selection, confirmation, gain, detection limits, structure."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
