"""Friction that follows the temperature, with a lag where the sensor sits away from the bearing.

    tau += (thermal_coulomb sign(v) + thermal_viscous v) (T_lag - reference),     lag dT_lag/dt = T - T_lag

`T_lag` starts in equilibrium at the first sample. Without a clock (one sample at a time, as in the simulator) the temperature
given is taken as `T_lag` itself. The reference only moves Coulomb and viscous friction. Grease thins as it warms, so both
amplitudes are mostly negative. Reference: Dressler 2012, 6.2 (friction and temperature); Bittencourt & Gunnarsson 2012.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.signal import lfilter

from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import format_amount, format_quantity
from tau_dyn.parameters import Parameter

_MIN_TIME_CONSTANT_S = 3.0  # s; a quicker drift is no matter of temperature
_STEP = 2.0  # ratio of neighbouring time constants tried; refinement does the rest


class ThermalDrift(JointwiseEffect):
    """Coulomb and viscous friction that change with a lagged temperature."""

    name = "thermal_drift"
    cause = True
    equation = "tau += (thermal_coulomb sign(v) + thermal_viscous v) (T_lag - reference), lag dT_lag/dt = T - T_lag"
    reference = "Dressler 2012, 6.2; Bittencourt & Gunnarsson 2012"
    reveals = "the same motion repeated from cold to warm, with a column temp_JOINT or temp_room in the log"
    mistaken_for = ("friction_change", "position_friction", "viscous_asymmetry")
    # Grease loses 3 to 8 % of its friction a kelvin when cold, less when warm (Bittencourt & Gunnarsson 2012)
    plausible = (
        PlausibleRange("thermal_coulomb", -0.1, 0.05, of="coulomb"),
        PlausibleRange("thermal_viscous", -0.1, 0.05, of="viscous"),
    )
    needs = ("temperature",)
    quantities = (("thermal_coulomb", "F/K"), ("thermal_viscous", "F/(V K)"))
    defaults = {"lag": 0.0, "reference": 20.0}
    setting_units = {"lag": "s", "reference": "degC"}
    refined = ("lag",)
    open_ends = {"lag": "high"}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the sign and the speed, times the temperature above the reference."""
        warmth = (
            filter_first_order(joint.signal("temperature"), joint.t, self.settings["lag"]) - self.settings["reference"]
        )
        return [joint.sign * warmth, joint.v * warmth]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the change a kelvin and the lag."""
        lag = self.settings["lag"]
        late = f", {format_quantity(lag, 's')} behind the sensor" if lag > 0 else ""
        coulomb, viscous = values["thermal_coulomb"], values["thermal_viscous"]
        return f"friction that changes with temperature by {format_amount(coulomb)} and {format_amount(viscous)}{late}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return no lag, and lags from 3 s to a third of the recording, a factor 2 apart."""
        longest = scene.duration / 3
        count = (
            1 + int(np.ceil(np.log(longest / _MIN_TIME_CONSTANT_S) / np.log(_STEP)))
            if longest > _MIN_TIME_CONSTANT_S
            else 0
        )
        return [{"lag": 0.0}, *({"lag": float(x)} for x in np.geomspace(_MIN_TIME_CONSTANT_S, longest, count))]


def filter_first_order(temperature: np.ndarray, t: np.ndarray | None, lag: float) -> np.ndarray:
    """Return temperatures (N,) after a first-order lag [s], in equilibrium at the first sample of the even clock (N,) [s]."""
    if t is None or lag <= 0 or len(t) < 2:
        return temperature
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    keep = np.exp(-dt / lag)
    return temperature[0] + lfilter([1 - keep], [1, -keep], temperature - temperature[0])
