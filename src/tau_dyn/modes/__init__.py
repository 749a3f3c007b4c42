"""Vibration logs -> resonances -> M, D, K."""

from tau_dyn.modes.find import find_modes
from tau_dyn.modes.model_file import ModelFile, load_state_space, save_state_space
from tau_dyn.modes.result import Modes
from tau_dyn.modes.state_space import StateSpace

__all__ = ["ModelFile", "Modes", "StateSpace", "find_modes", "load_state_space", "save_state_space"]
