"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from tau_dyn.diagnose.diagnose import diagnose
from tau_dyn.diagnose.result import (
    Diagnosis,
    Errors,
    Finding,
    Gain,
    Limit,
    Signature,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
)

__all__ = [
    "Diagnosis",
    "Errors",
    "Finding",
    "Gain",
    "Limit",
    "Signature",
    "Step",
    "TimeTrace",
    "Unexplained",
    "Untestable",
    "diagnose",
]
