"""Logs of commands and positions, without torque -> parameters through the closed loop."""

from .contact import Contact as Contact
from .diagnosis import (
    LOOP_CAUSES as LOOP_CAUSES,
    LoopDiagnosis as LoopDiagnosis,
    LoopFinding as LoopFinding,
    diagnose_loop as diagnose_loop,
)
from .identification import identify_loop as identify_loop, is_loop_log as is_loop_log
from .result import (
    LoopIdentification as LoopIdentification,
    LoopParameter as LoopParameter,
    PositionErrors as PositionErrors,
)
from .simulation import simulate_loop_log as simulate_loop_log
