"""The former name of `render`, where `build_page` and `print_result` take any result."""

from tau_dyn.public_names import attach_public_names

__getattr__, __dir__, __all__ = attach_public_names(__name__, __file__)
