"""What a simulation gets wrong, which physical cause explains it, and how much better the model is with it."""

from .diagnosis import (
    add_simulation as add_simulation,
    diagnose as diagnose,
    log_with_references as log_with_references,
)
from .loads import (
    build_body_parameters as build_body_parameters,
    format_load_sentence as format_load_sentence,
)
from .payload import (
    PAYLOAD as PAYLOAD,
    BodyEstimate as BodyEstimate,
    build_load_parameters as build_load_parameters,
    constrain_loads as constrain_loads,
    estimate_body as estimate_body,
    find_end_link as find_end_link,
    find_payload_frame as find_payload_frame,
    list_load_names as list_load_names,
)
from .proposal.propose import propose_motion as propose_motion
