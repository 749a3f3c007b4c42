"""What a robot controller takes: references and corrections at its sample period, RAPID programs; checked before."""

from .correction import (
    Correction as Correction,
    apply_correction as apply_correction,
    build_correction as build_correction,
    format_correction_text as format_correction_text,
    read_correction as read_correction,
    require_same_motion as require_same_motion,
    write_correction as write_correction,
)
from .rapid import (
    MIN_MOVE_S as MIN_MOVE_S,
    build_waypoints as build_waypoints,
    format_array as format_array,
    format_comment as format_comment,
    format_jointtarget as format_jointtarget,
    format_rapid_motion as format_rapid_motion,
    format_robtarget as format_robtarget,
    require_few_joints as require_few_joints,
    require_rapid_name as require_rapid_name,
)
from .reference import (
    DEFAULT_PERIOD_S as DEFAULT_PERIOD_S,
    CommandLimits as CommandLimits,
    PerJoint as PerJoint,
    broadcast_limit as broadcast_limit,
    build_reference as build_reference,
    check_motion as check_motion,
    compute_digest as compute_digest,
    count_samples_in_period as count_samples_in_period,
    list_exceeded_limits as list_exceeded_limits,
    read_reference as read_reference,
    write_reference as write_reference,
)
