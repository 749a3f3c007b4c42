"""The file that says how a rig's controller is set: gains of a cascade, one number for all joints or one a joint.

    position_gain: 160.18        # [1/s]
    velocity_gain: 243.45        # [unit per m/s or rad/s], the unit being the drive's own, here volts
    integral_rate: 0             # [1/s], how fast the velocity loop integrates
    speed_feedforward: 0         # share of the reference speed added to the command
    force_per_unit: 35.150652    # [N or N m per unit]; 1 where the drive's unit is the force
    limit: 10                    # [unit], largest output; by default the robot's effort limits

A number may also be a list in the order of the actuated joints, or a mapping from joint to number. The gains are required.
The law itself, with the way it takes the speed from positions, stands in `controllers.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml
from tau_dyn.robot import Robot
from tau_dyn.simulate.controllers import CascadeLaw

_DEFAULTS = {
    "position_gain": None,
    "velocity_gain": None,
    "integral_rate": 0.0,
    "speed_feedforward": 0.0,
    "force_per_unit": 1.0,
    "limit": None,
}
_MAY_BE_ZERO = ("integral_rate", "speed_feedforward")


def read_law_file(path: str | Path, robot: Robot) -> CascadeLaw:
    """Return the controller that a file describes, for a robot's actuated joints.

    Raises:
        InputError: The file is missing or not such a file; an entry is unknown, missing, or not a number that can be.
    """
    where, content = str(path), read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InputError("file_format", f"{where}: a controller file is a mapping with {', '.join(_DEFAULTS)}")
    for key in content:
        if key not in _DEFAULTS:
            raise UnknownName("controller entry", str(key), _DEFAULTS, where)
    for key in ("position_gain", "velocity_gain"):
        if content.get(key) is None:
            raise InputError(
                "file_format", f"{where}: '{key}' is missing; a controller needs a position gain and a velocity gain"
            )
    given = {**_DEFAULTS, **{key: value for key, value in content.items() if value is not None}}
    found = {key: _numbers(key, value, robot, where) for key, value in given.items() if value is not None}
    if "limit" not in found:
        found["limit"] = robot.effort_limit / found["force_per_unit"]
    return CascadeLaw(
        found["position_gain"],
        found["velocity_gain"],
        found["integral_rate"],
        found["speed_feedforward"],
        found["force_per_unit"],
        found["limit"],
    )


def _numbers(key: str, value: object, robot: Robot, where: str) -> np.ndarray:
    """Return one number a joint (na,)."""
    joints = robot.actuated
    if isinstance(value, Mapping):
        for joint in value:
            if joint not in joints:
                raise UnknownName("actuated joint", str(joint), joints, f"{where}: {key}")
        missing = [joint for joint in joints if joint not in value]
        if missing:
            raise InputError("file_format", f"{where}: {key} has no number for joint {missing[0]}")
        row = [value[joint] for joint in joints]
    elif isinstance(value, list):
        if len(value) != len(joints):
            raise InputError(
                "wrong_shape",
                f"{where}: {key} has {len(value)} number(s) for {len(joints)} joint(s); give one, or one a joint in the "
                f"order {', '.join(joints)}",
            )
        row = value
    else:
        row = [value] * len(joints)
    return np.array([_number(key, x, where) for x in row])


def _number(key: str, value: object, where: str) -> float:
    """Return a number that this entry can be."""
    least = "zero or more" if key in _MAY_BE_ZERO else "above zero"
    wanted = f"{where}: {key} must be a {'' if key == 'limit' else 'finite '}number {least}"
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = "; YAML reads a number such as 1.0e+5 only with a point and a sign" if isinstance(value, str) else ""
        raise InputError("file_format", f"{wanted}, not {_short(value)}{hint}")
    number = float(value)
    fits = number >= 0 if key in _MAY_BE_ZERO else number > 0
    if not fits or not (isfinite(number) or key == "limit"):
        raise InputError("file_format", f"{wanted}, not {_short(value)}")
    return number


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
