"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from tau_dyn.deprecated_names import get_deprecated
from tau_dyn.diagnose.diagnose import diagnose
from tau_dyn.diagnose.nominal import PARAMETER_CAUSES
from tau_dyn.diagnose.propose import propose_motion
from tau_dyn.diagnose.result import (
    Diagnosis,
    Finding,
    Gain,
    Limit,
    OutputErrors,
    Signature,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
)
from tau_dyn.diagnose.simulated import add_simulation

__all__ = [
    "PARAMETER_CAUSES",
    "Diagnosis",
    "Finding",
    "Gain",
    "Limit",
    "OutputErrors",
    "Signature",
    "Step",
    "TimeTrace",
    "Unexplained",
    "Untestable",
    "add_simulation",
    "diagnose",
    "propose_motion",
]


def __getattr__(name: str) -> object:
    return get_deprecated(__name__, name)
