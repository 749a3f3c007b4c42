"""What a robot controller takes: references and corrections at its sample period, RAPID programs; checked before."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
