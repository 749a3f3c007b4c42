"""The model in use: feedforward."""

from tau_dyn.control.feedforward import Feedforward

__all__ = ["Feedforward"]
