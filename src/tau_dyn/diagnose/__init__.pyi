"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from .diagnosis import (
    add_simulation as add_simulation,
    diagnose as diagnose,
    log_with_references as log_with_references,
)
from .payload import (
    estimate_body as estimate_body,
    find_end_link as find_end_link,
    find_payload_frame as find_payload_frame,
)
from .proposal.propose import propose_motion as propose_motion
