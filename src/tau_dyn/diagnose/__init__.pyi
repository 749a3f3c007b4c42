"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from .diagnosis import (
    add_simulation as add_simulation,
    diagnose as diagnose,
    log_with_references as log_with_references,
)
from .payload import (
    compute_body_properties as compute_body_properties,
    differentiate_body_properties as differentiate_body_properties,
    find_end_link as find_end_link,
)
from .proposal.propose import propose_motion as propose_motion
