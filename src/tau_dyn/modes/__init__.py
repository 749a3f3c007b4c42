"""Vibration logs -> resonances -> M, D, K."""

from tau_dyn.modes.find import find_modes
from tau_dyn.modes.model_file import ModelFile, load_state_space, save_state_space
from tau_dyn.modes.operational import find_operational_modes
from tau_dyn.modes.operational_result import OperationalModes
from tau_dyn.modes.result import Modes
from tau_dyn.modes.state_space import StateSpace

__all__ = [
    "ModelFile",
    "Modes",
    "OperationalModes",
    "StateSpace",
    "find_modes",
    "find_operational_modes",
    "load_state_space",
    "save_state_space",
]
