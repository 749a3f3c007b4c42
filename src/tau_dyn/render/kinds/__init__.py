"""How each kind of result is presented: its words, tables and figures, once."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
