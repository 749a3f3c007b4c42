"""Friction that follows something beside the speed: the load carried, the temperature, the campaign.

    load_friction     tau += load_friction |load| sign(v)
    thermal_drift     tau += (thermal_coulomb sign(v) + thermal_viscous v) (T_lag - reference),   lag dT_lag/dt = T - T_lag
    friction_change   tau += [campaign = number] (coulomb_change sign(v) + viscous_change v)

For a cart, `load` is the force that its rod puts across the guideway; for a hinge, the rigid-body torque that its reducer
transmits (`Mechanism.guide_load`); the model's masses give it, not the data. `T_lag` starts in equilibrium at the first sample;
without a clock the temperature given is taken for it. The reference only moves Coulomb and viscous friction. A campaign is one
log, numbered from zero in the order given. Reference: Hamon, Gautier & Garrec 2010; Dressler 2012, 6.2; Bittencourt &
Gunnarsson 2012.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.signal import lfilter

from tau_dyn.effects.effect import PlausibleRange
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.effects.words import format_amount, format_quantity
from tau_dyn.parameters import Parameter


class LoadFriction(JointwiseEffect):
    """Coulomb friction in proportion to the load."""

    name = "load_friction"
    cause = True
    equation = "tau += load_friction |load| sign(v)"
    reference = "Hamon, Gautier & Garrec 2010"
    reveals = "the same strokes in both directions at places and accelerations where the load differs much"
    mistaken_for = ("position_friction", "coulomb_asymmetry", "payload")
    # 0.1 to 1 % in rolling guides, 20 % in sliding ones; a reducer of 65 % efficiency loses half of what it transmits
    plausible = (PlausibleRange("load_friction", 0.0, 0.5),)
    needs = ("load",)
    quantities = (("load_friction", "1"),)
    sentence = "friction of {load_friction} of the load that its guide or reducer carries"
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the load's size against the motion."""
        return [np.abs(joint.signal("load")) * joint.sign]


_MIN_LAG_S = 3.0  # s; a quicker drift is no matter of temperature
_LAG_STEP = 2.0  # ratio of neighbouring time constants tried; refinement does the rest


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
        count = 1 + int(np.ceil(np.log(longest / _MIN_LAG_S) / np.log(_LAG_STEP))) if longest > _MIN_LAG_S else 0
        return [{"lag": 0.0}, *({"lag": float(x)} for x in np.geomspace(_MIN_LAG_S, longest, count))]


def filter_first_order(temperature: np.ndarray, t: np.ndarray | None, lag: float) -> np.ndarray:
    """Return temperatures (N,) after a first-order lag [s], in equilibrium at the first sample of the even clock (N,) [s]."""
    if t is None or lag <= 0 or len(t) < 2:
        return temperature
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    keep = np.exp(-dt / lag)
    return temperature[0] + lfilter([1 - keep], [1, -keep], temperature - temperature[0])


class FrictionChange(JointwiseEffect):
    """Coulomb and viscous friction that one log has beyond the others."""

    name = "friction_change"
    cause = True
    equation = "tau += [campaign = number] (coulomb_change sign(v) + viscous_change v)"
    reference = "Dressler 2012, 6.2"
    reveals = "the same motion in two or more logs, recorded at the same temperature"
    mistaken_for = ("thermal_drift", "drive_gain")
    # A service or a cold start at most halves friction, or triples it
    plausible = (
        PlausibleRange("coulomb_change", -1.0, 2.0, of="coulomb"),
        PlausibleRange("viscous_change", -1.0, 3.0, of="viscous"),
    )
    needs = ("campaign",)
    quantities = (("coulomb_change", "F"), ("viscous_change", "F/(V)"))
    defaults = {"number": 1.0}

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return sign and speed in the campaign, zero elsewhere."""
        here = joint.signal("campaign") == self.settings["number"]
        return [joint.sign * here, joint.v * here]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return what changed in which log."""
        coulomb, viscous = values["coulomb_change"], values["viscous_change"]
        return (
            f"friction in log {1 + int(self.settings['number'])} that differs from the others' by "
            f"{format_amount(coulomb)} and {format_amount(viscous)}"
        )

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return each log; of two, the second, since the first differs from it by as much."""
        first = 0 if scene.campaigns > 2 else 1
        return [{"number": float(k)} for k in range(first, scene.campaigns)]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that one log has nothing to differ from."""
        return ("there is only one log", cls.reveals) if scene.campaigns < 2 else super().untestable(scene)
