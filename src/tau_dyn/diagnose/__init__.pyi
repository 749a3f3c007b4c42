"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from .diagnosis import diagnose as diagnose
from .nominal import PARAMETER_CAUSES as PARAMETER_CAUSES
from .output_errors import Gain as Gain, OutputErrors as OutputErrors, Step as Step
from .propose import propose_motion as propose_motion
from .result import (
    Diagnosis as Diagnosis,
    Finding as Finding,
    Limit as Limit,
    Signature as Signature,
    Status as Status,
    TimeTrace as TimeTrace,
    Unexplained as Unexplained,
    Untestable as Untestable,
)
from .simulated import add_simulation as add_simulation, log_with_references as log_with_references
