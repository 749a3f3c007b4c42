r"""Position-controlled drives as linear systems: `q_J = q_ref_J`, late and through a first-order lag.

The thesis' closed drives, (6.11), are `G_a(q) = q^-d b / (1 - a q^-1)` at 4 ms. Sampling `1 / (T s + 1)` with a held input
gives one step of that `q^-d` by itself, so the pure delay is `d - 1` steps and `T = -dt / ln a`. The robot does not push the
drives away: its motion has no effect on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError


@dataclass(frozen=True)
class PositionDrives:
    """One first-order lag a joint, and a delay.

    Attributes:
        time_constants: One a joint [s].
        delay: Of all joints [s].
    """

    time_constants: tuple[float, ...]
    delay: float = 0.0

    def __post_init__(self) -> None:
        """Refuse lags and delays that no drive has."""
        if not all(0 < t < np.inf for t in self.time_constants) or not 0 <= self.delay < np.inf:
            raise InputError("invalid_value", "a drive's time constant must be positive, its delay not below zero")

    @classmethod
    def from_sampled(cls, poles: Sequence[float], dt: float, samples: int) -> PositionDrives:
        """Return the drives `q^-samples (1 - a) / (1 - a q^-1)` with poles `a` (na,) at a step `dt` [s]."""
        if not all(0 < a < 1 for a in poles) or samples < 1:
            raise InputError(
                "invalid_value", "a sampled lag has its pole between 0 and 1 and at least one sample of delay"
            )
        return cls(tuple(float(-dt / np.log(a)) for a in poles), (samples - 1) * dt)


L1_DRIVES = PositionDrives.from_sampled((0.9647, 0.9656, 0.9728), 0.004, 5)
"""The L1 prototype's, Dressler 2012, (6.11); the printed numerators differ from `1 - a` by up to 1.03 %."""
