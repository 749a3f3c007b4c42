"""Logs of commands and positions, without torque -> parameters through the closed loop."""

from .contact import Contact as Contact
from .diagnosis import diagnose_loop as diagnose_loop
from .identification import identify_loop as identify_loop
from .preparation import LoopOptions as LoopOptions, is_loop_log as is_loop_log
from .result import (
    LoopIdentification as LoopIdentification,
    LoopParameter as LoopParameter,
    PositionErrors as PositionErrors,
)
from .simulation import simulate_loop_log as simulate_loop_log
