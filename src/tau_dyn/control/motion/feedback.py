"""What a plan leaves for the feedback: the noise that its gains make of the encoders', and what the model does not know.

A cascade's speed is a difference of two positions over two samples. So white noise sigma of the positions becomes noise
`sigma sqrt((kp + 1 / 2 dt)^2 + (1 / 2 dt)^2)` of its speed error, times K of force (`simulate/controllers.py`; the plant hardly
answers at these frequencies, and the integral, which sums differences, adds little).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.per_joint import PerJoint
from tau_dyn.exceptions import InputError
from tau_dyn.simulate import CascadeLaw

PEAK = 4.0
"""Standard deviations that a second's samples of white noise hardly leave."""


def estimate_feedback_noise(law: CascadeLaw, q: np.ndarray, encoder_noise: PerJoint, dt: float = 1e-3) -> np.ndarray:
    """Return the standard deviation (na,) of the feedback's forces [N or N m] at rest at one of the positions, the largest.

    Args:
        law: The gains.
        q: Actuated positions (N, na), where the mass matrix counts.
        encoder_noise: Standard deviation of the positions' noise [m or rad].
        dt: The controller's step [s].
    """
    if not dt > 0 or not np.all(np.asarray(encoder_noise) >= 0):
        raise InputError(
            "invalid_value", "the noise of the feedback needs a step above zero and encoder noise not below zero"
        )
    error = np.asarray(encoder_noise) * np.hypot(law.position_gain + 0.5 / dt, 0.5 / dt)
    size = law.force_per_unit * law.velocity_gain
    if law.inertia is None:
        return size * error
    forces = [np.sqrt((law.inertia(x) ** 2) @ (law.velocity_gain * error) ** 2) for x in q]
    return law.force_per_unit * np.max(forces, axis=0)


def compute_feedback_margin(
    limits: MotionLimits,
    law: CascadeLaw,
    q: np.ndarray,
    encoder_noise: PerJoint,
    *,
    unknown: float = 0.05,
    dt: float = 1e-3,
) -> float:
    """Return the margin that a plan should keep for the feedback, for `MotionLimits.of(..., margin=...)`.

    So that `(1 - margin) force (1 + unknown) + PEAK noise` stays within every drive's limit.

    Args:
        limits: Limits without a margin.
        law: The gains of the feedback.
        q: Actuated positions (N, na) on the way, such as both ends.
        encoder_noise: Standard deviation of the positions' noise [m or rad].
        unknown: Share by which the needed forces may differ from the model's.
        dt: The controller's step [s].

    Raises:
        InputError: The noise alone fills a drive's limit.
    """
    if not 0 <= unknown < 1:
        raise InputError("invalid_value", f"the unknown share of the forces must be from 0 to below 1, not {unknown:g}")
    share = PEAK * estimate_feedback_noise(law, q, encoder_noise, dt) / limits.force
    if not np.all(share < 1):
        raise InputError(
            "invalid_value",
            f"the feedback makes of the encoders' noise {100 * share.max():.0f} % of a drive's limit; lower its gains",
        )
    return float(1 - (1 - share.max()) / (1 + unknown))
