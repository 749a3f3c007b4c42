"""What a robot controller takes: references and corrections at its sample period, RAPID programs; checked before."""

from tau_dyn.control.interface.check import broken_limits, check_motion
from tau_dyn.control.interface.correction import (
    Correction,
    corrected,
    correction_of,
    read_correction,
    write_correction,
)
from tau_dyn.control.interface.limits import CommandLimits
from tau_dyn.control.interface.period import PERIOD
from tau_dyn.control.interface.rapid import rapid_motion
from tau_dyn.control.interface.reference import read_reference, reference_of, write_reference

__all__ = [
    "PERIOD",
    "CommandLimits",
    "Correction",
    "broken_limits",
    "check_motion",
    "corrected",
    "correction_of",
    "rapid_motion",
    "read_correction",
    "read_reference",
    "reference_of",
    "write_correction",
    "write_reference",
]
