"""How each kind of result is presented: its words, tables and figures, once."""

from .motion import ExcitingMotion as ExcitingMotion, SimulatedLog as SimulatedLog
