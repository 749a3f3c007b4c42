"""Which kinds of measurement logs hold: forces, tool positions that say more than the encoders do, encoders behind the gear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.diagnose.tool_pieces import OUTPUTS
from tau_dyn.log import Log, estimate_encoder_noise
from tau_dyn.model import Model
from tau_dyn.robot import Robot

_LOOKED_AT = 400  # samples of a log for which forward kinematics is computed; bounds time
_ENCODERS = 3.0  # standard deviations of the encoders' noise


def has_forces(robot: Robot, logs: Sequence[Log]) -> bool:
    """Tell whether all logs have the force of every actuated joint."""
    return all(log.has("tau", robot.actuated) for log in logs)


def has_tool(robot: Robot, logs: Sequence[Log]) -> bool:
    """Tell whether all logs have tool positions that forward kinematics can be held against."""
    return robot.tool_frame is not None and all(set(OUTPUTS) <= set(log.channels) for log in logs)


def is_tool_inconsistent(model: Model, logs: Sequence[Log]) -> bool:
    """Tell whether measured tools are farther from forward kinematics than the encoders' noise puts them.

    Where they are not, there is nothing to explain: the tool was computed from the encoders, or agrees with them.
    """
    joints = model.robot.actuated
    for log in logs:
        read = log.joint("q", joints)
        few = slice(None, None, max(1, log.n_samples // _LOOKED_AT))
        away = np.column_stack([log.channels[c][few] for c in OUTPUTS]) - model.mechanism.tool_position(read[few])
        spread = float(np.sqrt(np.mean(np.sum((away - away.mean(axis=0)) ** 2, axis=1))))
        noise = model.mechanism.tool_jacobian(read[few]) * estimate_encoder_noise(read)
        if spread > _ENCODERS * float(np.sqrt(np.mean(np.sum(noise**2, axis=(1, 2))))):
            return True
    return False


def has_links(logs: Sequence[Log]) -> bool:
    """Tell whether all logs have link-side encoders."""
    return all(log.joints("q_link") for log in logs)
