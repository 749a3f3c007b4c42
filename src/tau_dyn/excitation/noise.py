"""How noisy forces and encoders are, and what that noise weighs in an estimate.

Force noise is taken as white at the log's rate. A joint's encoder noise of standard deviation s_q makes, through the
acceleration that is differentiated from it, a force of density `m^2 (2 pi f)^4 s_q^2`; over a band up to f it weighs as much
as white noise of variance `m^2 (2 pi f)^4 s_q^2 / 5` would, with m the inertia that the joint feels at home.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors

PER_JOINT = "one number, or one for each of the {} actuated joints"


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of what is logged.

    Attributes:
        force: Of forces (na,) [N or N m].
        encoder: Of positions (na,) [m or rad].
        rate_hz: Rate of the log [Hz].
        source: Where the numbers came from, in words.
    """

    force: np.ndarray
    encoder: np.ndarray
    rate_hz: float = 1000.0
    source: str = "given"

    @classmethod
    def given(
        cls,
        robot: Robot,
        force: Sequence[float] | np.ndarray,
        encoder: Sequence[float] | np.ndarray,
        rate_hz: float = 1000.0,
        source: str = "given",
    ) -> Noise:
        """Return noise of one number for all joints or one a joint each.

        Raises:
            InputError: Another number of them, or a force noise that is not above zero.
        """
        na, found = robot.na, []
        for name, values in (("force", force), ("encoder", encoder)):
            x = np.asarray(values, float).ravel()
            if len(x) not in (1, na):
                raise InputError("wrong_shape", f"{name} noise: give {PER_JOINT.format(na)}, not {len(x)}")
            found.append(np.broadcast_to(x, (na,)).copy())
        if not np.all(found[0] > 0):
            raise InputError(
                "invalid_value", "force noise must be above zero; without noise every motion tells everything"
            )
        return cls(found[0], found[1], rate_hz, source)

    @classmethod
    def typical(cls, model: Model, tau: np.ndarray, rate_hz: float = 1000.0) -> Noise:
        """Return a good industrial drive's: 1 % of the rms of forces (n, na), and half an encoder step; see `Sensors`."""
        sensors = Sensors.typical(model.robot)
        rms = np.sqrt(np.mean(tau**2, axis=0))
        force = np.maximum(0.01 * rms, 1e-3 * float(rms.max(initial=0.0)))
        force = np.where(force > 0, force, 1.0)
        step = np.broadcast_to(np.asarray(sensors.encoder_noise, float), (model.robot.na,))
        return cls(force, step.copy(), rate_hz, "typical of good drives: 1 % of the rms force, half an encoder step")

    def weighing(self, model: Model, band_hz: float) -> np.ndarray:
        """Return the force noise (na,) that weighs as much as forces and encoders together, up to a frequency [Hz]."""
        inertia = np.diagonal(model.mechanism.inertia(model.robot.home[None])[0])
        return np.hypot(self.force, inertia * (2 * np.pi * band_hz) ** 2 * self.encoder / np.sqrt(5))
