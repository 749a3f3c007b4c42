"""What a robot controller takes: references and corrections at its sample period, RAPID programs; checked before."""

from tau_dyn.control.interface.check import check_motion, list_exceeded_limits
from tau_dyn.control.interface.correction import (
    Correction,
    apply_correction,
    build_correction,
    read_correction,
    write_correction,
)
from tau_dyn.control.interface.limits import CommandLimits
from tau_dyn.control.interface.period import DEFAULT_PERIOD_S
from tau_dyn.control.interface.rapid import format_rapid_motion
from tau_dyn.control.interface.reference import build_reference, read_reference, write_reference
from tau_dyn.deprecated_names import get_deprecated

__all__ = [
    "DEFAULT_PERIOD_S",
    "CommandLimits",
    "Correction",
    "apply_correction",
    "build_correction",
    "build_reference",
    "check_motion",
    "format_rapid_motion",
    "list_exceeded_limits",
    "read_correction",
    "read_reference",
    "write_correction",
    "write_reference",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
