"""Every cause that `diagnose` and `calibrate` can name: its law, its plausible range, the motion that reveals it.

A cause of forces is an effect of the catalogue, or a parameter that differs from its trusted nominal value; a cause of geometry
changes the positions of joints and frames.
"""

from __future__ import annotations

from typing import NamedTuple

from tau_dyn.effects.catalogue import EFFECTS
from tau_dyn.effects.effect import describe_ranges

PARAMETER_CAUSES = {
    "payload": "tau += Y_last(q, v, a) (ten inertial numbers of the payload)",
    "link_mass": "a link's mass differs from its nominal value",
    "force_scale": "tau_log = force_scale tau, of one joint",
}
"""Causes that are detected only by comparison with a trusted nominal value, with their equations; `drive_gain` is an effect,
too."""
CONVENTIONS = {
    "joint_sign": "q_real = -q",
    "joint_zero": "q_real = q + k pi / 2",
    "columns_exchanged": "two columns of joints or of x, y, z are exchanged",
    "joint_unit": "q in degrees or millimetres",
    "axis_sign": "x, y or z has the opposite sign of the orientation's axes",
    "position_unit": "x, y, z in mm, cm or inch",
    "quaternion_order": "quaternion w x y z, or three angles in another order",
    "inverse_poses": "the device in the target's frame, X_m = X^-1",
    "row_shift": "joints of row k belong to the pose of row k + n",
}
"""Conventions of a pose file that `calibrate` names and applies, with their equations: they have no fitted parameter."""
GEOMETRY_CAUSES = {
    **CONVENTIONS,
    "rod_length": "|A - B| = L + dL",
    "joint_placement": "A or B displaced by a constant in its link's frame",
    "guideway_nonparallel": "A = A_0 + q v_i, v_i different for each guideway",
    "pinion_scale": "A = A_0 + q (1 + pinion_scale) v",
    "cart_tilt": "A = A_0 + q (v + drift), drift different for each rod on a cart",
    "transmission_error": "q_real = q + error_sin sin(2 pi q / error_period) + error_cos cos(2 pi q / error_period)",
    "guideway_not_straight": "A displaced by bend(q), linear between knots",
    "guideway_compliance": "A displaced by guideway_compliance F across, drive_compliance F along the guideway, F the rods' pull",
    "backlash": "q_real = q - backlash / 2 sign of the approach",
    "joint_coupling": "q_real = q + coupling q_other",
    "gravity_deflection": "q_real = q + gravity_compliance tau(q) + load_deflection tau_1(q), tau by gravity, tau_1 on 1 kg",
    "drive_compliance": "q_real = q + drive_compliance Q(q_real), Q the force of weights and known loads on the drive",
    "joint_eccentricity": "q_real = q + eccentricity_sin sin(q) + eccentricity_cos cos(q)",
    "joint_delay": "q_real = q + delay v: the joints were read so long before the tool was measured",
    "tool_frame": "the target is at another place on the tool in another campaign",
    "device_moved": "the device stood elsewhere when the held-out poses were measured",
    "target_moved": "the target sat elsewhere on the tool when the held-out poses were measured",
    "base_frame": "the robot's base is at another place in the device's frame in another campaign",
}
"""Causes that `calibrate` names, with their equations."""
GEOMETRY_SENTENCES = {
    "rod_length": "Rod lengths differ from the robot file",
    "joint_placement": "Joint positions differ from the robot file",
    "guideway_nonparallel": "Guideways are not parallel",
    "pinion_scale": "The drive's scale is wrong",
    "cart_tilt": "Carts turn as they travel",
    "transmission_error": "The drive has a periodic error",
    "guideway_not_straight": "The guideway has a straightness error",
    "guideway_compliance": "Cart and drive are compliant",
    "backlash": "The drive has backlash",
    "joint_coupling": "The second joint moves the first along",
    "gravity_deflection": "The joint yields to gravity",
    "drive_compliance": "Drives yield to their load",
    "joint_eccentricity": "The joint's angle has an error once a turn",
    "joint_delay": "Joints and tool were measured at different times",
    "tool_frame": "The target moved between campaigns",
    "base_frame": "The base moved between campaigns",
    "device_moved": "The device moved before the held-out poses",
    "target_moved": "The target moved before the held-out poses",
    "joint_sign": "The file counts the joint the other way (sign)",
    "joint_zero": "The joint's zero is a quarter turn or a half turn away",
    "columns_exchanged": "Columns of the pose file are exchanged",
    "joint_unit": "Joint positions are in another unit",
    "axis_sign": "An axis of the positions has the opposite sign",
    "position_unit": "Positions are in another unit than m",
    "quaternion_order": "The quaternion's order is w x y z",
    "inverse_poses": "The poses or orientations are inverse",
    "row_shift": "Joints and poses are shifted by rows",
}
"""The same causes as sentences."""


class LoopCause(NamedTuple):
    """A cause in a servo's loop: the law's entries that it frees, its own value first; its equation; the motion that reveals it.

    `forms` are entries that are 0 or 1; the search takes the better value.
    """

    entries: tuple[str, ...]
    equation: str
    reveals: str
    mistaken_for: tuple[str, ...] = ()
    forms: tuple[str, ...] = ()


LOOP_CAUSES = {
    "gain_error": LoopCause(
        ("position_gain",), "u = position_gain e", "a weighed mass, or gravity at several positions", ("drive_gain", "link_mass")
    ),
    "dead_band": LoopCause(("dead_band",), "e less dead_band", "slow sweeps of small amplitude", ("stiction", "backlash")),
    "supply_sag": LoopCause(
        ("supply_sag",), "u (1 - supply_sag |u|)", "large steps and small ones at one load", ("drive_law",)
    ),
    "drive_law": LoopCause(
        ("drive_exponent",), "tau ~ |x|^drive_exponent", "large steps and small ones at one load", ("supply_sag",)
    ),
    "back_emf": LoopCause(
        ("back_emf",), "x = u - back_emf v", "steps that saturate the servo, or phases with the motor off", ("viscous",)
    ),
    "command_delay": LoopCause(
        ("command_delay",), "goal(t) = command(t - command_delay)", "steps and fast sweeps", ("delay", "joint_compliance")
    ),
    "delay": LoopCause(
        ("torque_delay",), "the motor's u(t) = the law's u(t - torque_delay)", "fast sweeps near the loop's bandwidth",
        ("command_delay", "joint_compliance"),
    ),
    "stiction": LoopCause(
        ("stiction",), "friction + stiction exp(-|v| / stiction_speed)", "slow sweeps through rest", ("dead_band",)
    ),
    "goal_profile": LoopCause(
        ("acceleration_limit",), "|goal''| <= acceleration_limit, braked to rest at the command; steps_pass 1: steps pass",
        "fast streamed sweeps, and steps", ("command_delay", "delay"), ("steps_pass",),
    ),
    "load_friction": LoopCause(
        ("load_friction",), "friction + load_friction |tau|", "slow motion at several loads", ("carried_friction",)
    ),
    "carried_friction": LoopCause(
        ("carried_friction",), "friction + carried_friction |load|", "slow motion at several loads, and fast motion without load",
        ("load_friction",),
    ),
    "joint_compliance": LoopCause(
        ("joint_compliance", "joint_damping"), "motor - link = joint_compliance tau_link, with joint_damping",
        "a chirp through the resonance", ("delay", "backlash"),
    ),
    "backlash": LoopCause(
        ("backlash",), "|motor - link| <= backlash / 2 without torque", "reversals of a load that changes its side",
        ("dead_band", "joint_compliance"),
    ),
}  # fmt: skip
"""Causes that `diagnose` names from commands and positions alone, through the loop; numbers are entries of a servo's law."""


def list_causes() -> list[dict[str, str]]:
    """Return one row per cause and command that names it: `cause`, `named_by`, `equation`, `range`, `revealed_by`.

    Example:
        >>> laws = {row["cause"]: row["equation"] for row in reversed(td.list_causes())}
        >>> laws["delay"], laws["rod_length"]
        ('tau_log(t) = tau(t - delay)', '|A - B| = L + dL')
    """
    rows = [
        {"cause": name, "named_by": "diagnose", "equation": effect.equation, "range": describe_ranges(effect.plausible),
         "revealed_by": effect.reveals}
        for name, effect in EFFECTS.items()
        if effect.cause
    ]  # fmt: skip
    empty = {"range": "", "revealed_by": ""}
    rows += [{"cause": n, "named_by": "diagnose", "equation": x, **empty} for n, x in PARAMETER_CAUSES.items()]
    rows += [{"cause": n, "named_by": "calibrate", "equation": x, **empty} for n, x in GEOMETRY_CAUSES.items()]
    return rows + [
        {"cause": name, "named_by": "diagnose, in the loop", "equation": loop.equation, "range": "", "revealed_by": loop.reveals}
        for name, loop in LOOP_CAUSES.items()
    ]  # fmt: skip
