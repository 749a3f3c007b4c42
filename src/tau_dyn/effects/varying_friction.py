"""Friction that depends on more than the joint's speed: temperature, campaign, position, passive bearings.

The temperature's lag starts in equilibrium at the first sample; without a clock the given temperature is used. Its reference
value only shifts Coulomb and viscous friction. A campaign is one log, numbered from zero in the order given.

Position-dependent friction is a sum of Legendre polynomials, nearly independent of each other if the joint covers its range
evenly; P_0 is Coulomb friction itself. Beyond the range it is constant.

A passive bearing turns with `w = P v`, `P` from the loops (`Mechanism.passive_rates`); by virtual work the motors add `P'`
times its friction, with one pair of coefficients for all bearings. `w / |w|` reverses with the bearing, not with a joint: when
all carts move equally, no rod turns. Then the direction is noise; identification leaves such samples out (`other_speeds`), a
smoothed sign (feedforward) fades with the fastest joint's, and the simulator takes the force at the current speed, so that it
brakes but cannot hold. Reference: Dressler 2012, 6.2; Bittencourt & Gunnarsson 2012; Khalil & Dombre 2002, 9.6 and ch. 10
(virtual work).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.polynomial import legendre

from tau_dyn.effects.effect import NO_EXPERIMENT, Effect, PlausibleRange, format_amount, format_quantity, spell_unit
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.parameters import Parameter, Parameters

_MIN_LAG_S = 3.0  # s; a faster drift is not due to temperature
_LAG_STEP = 2.0  # ratio of neighbouring time constants tried; refinement does the rest


class ThermalDrift(JointwiseEffect):
    """Coulomb and viscous friction that change with a lagged temperature."""

    name = "thermal_drift"
    cause = True
    equation = "tau += (thermal_coulomb sign(v) + thermal_viscous v) (T_lag - reference), lag dT_lag/dt = T - T_lag"
    reference = "Dressler 2012, 6.2; Bittencourt & Gunnarsson 2012"
    reveals = "the same motion repeated from cold to warm, with a column temp_JOINT or temp_room in the log"
    mistaken_for = ("friction_change", "position_friction", "viscous_asymmetry")
    # Grease loses 3 to 8 % of its friction per kelvin when cold, less when warm (Bittencourt & Gunnarsson 2012)
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
        """Return the change per kelvin and the lag."""
        lag = self.settings["lag"]
        late = f", {format_quantity(lag, 's')} behind the sensor" if lag > 0 else ""
        coulomb, viscous = values["thermal_coulomb"], values["thermal_viscous"]
        return f"friction that changes with temperature by {format_amount(coulomb)} and {format_amount(viscous)}{late}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return no lag, and lags from 3 s to a third of the recording, in steps of a factor 2."""
        longest = scene.duration / 3
        count = 1 + int(np.ceil(np.log(longest / _MIN_LAG_S) / np.log(_LAG_STEP))) if longest > _MIN_LAG_S else 0
        return [{"lag": 0.0}, *({"lag": float(x)} for x in np.geomspace(_MIN_LAG_S, longest, count))]


def filter_first_order(temperature: np.ndarray, t: np.ndarray | None, lag: float) -> np.ndarray:
    """Return temperatures (N,) after a first-order lag [s], in equilibrium at the first sample of the even clock (N,) [s]."""
    if t is None or lag <= 0 or len(t) < 2:
        return temperature
    from scipy.signal import lfilter

    dt = float(t[-1] - t[0]) / (len(t) - 1)
    keep = np.exp(-dt / lag)
    return temperature[0] + lfilter([1 - keep], [1, -keep], temperature - temperature[0])


class FrictionChange(JointwiseEffect):
    """Additional Coulomb and viscous friction in one log."""

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
        """Return the change and its log."""
        coulomb, viscous = values["coulomb_change"], values["viscous_change"]
        return (
            f"friction in log {1 + int(self.settings['number'])} that differs from the others' by "
            f"{format_amount(coulomb)} and {format_amount(viscous)}"
        )

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return each log; for two logs only the second, since the first differs from it by the same amount."""
        first = 0 if scene.campaigns > 2 else 1
        return [{"number": float(k)} for k in range(first, scene.campaigns)]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that a single log has no other log to differ from."""
        return ("there is only one training log", cls.reveals) if scene.campaigns < 2 else super().untestable(scene)


_DEGREES = (2, 5, 8, 12)
_SECONDS = 3.0
"""Duration of motion [s] for each term, to cover its part of the range in both directions more than once."""


class PositionFriction(JointwiseEffect):
    """Coulomb friction as a polynomial of the position."""

    name = "position_friction"
    cause = True
    equation = "tau += sign(v) sum_k position_friction_k P_k((q - middle) / half), k = 1 .. degree"
    reference = "Dressler 2012, 6.2; Khalil & Dombre 2002, 9.6"
    reveals = "slow constant-speed strokes over the whole range, in both directions"
    mistaken_for = ("load_friction", "thermal_drift", "cyclic_ripple", "passive_joint_friction")
    # Friction remains positive at each position
    plausible = (PlausibleRange("position_friction", -1.0, 1.0, of="coulomb"),)
    quantities = ()
    defaults = {"middle": 0.0, "half": 1.0, "degree": 2}
    setting_units = {"middle": "Q", "half": "Q"}
    positive = ("half",)
    whole = ("degree",)

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One amplitude per degree, from degree one up."""
        return tuple((f"position_friction_{k}", "F") for k in range(1, int(self.settings["degree"]) + 1))

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the sign times each polynomial."""
        P = self._polynomials(joint.q)
        return [joint.sign * P[:, k] for k in range(P.shape[1])]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the positions of lowest and highest friction, relative to its mean over the range."""
        q = self.settings["middle"] + self.settings["half"] * np.linspace(-1, 1, 201)
        friction = self._polynomials(q) @ np.array([p.value for p in values.values()])
        force, place = self.units[joint], spell_unit("Q", self.units[joint])
        low, high = int(np.argmin(friction)), int(np.argmax(friction))
        return (
            f"friction {format_quantity(float(friction[high] - friction[low]), force)} higher at "
            f"{format_quantity(float(q[high]), place)} than at {format_quantity(float(q[low]), place)}"
        )

    def lookalikes(self) -> list[Effect]:
        """Return viscous friction with the same dependence on the position: `v` in place of `sign(v)`."""
        return [_PositionDrag(self.joints, self.units.values(), label=self.label, **self.settings)]

    def _polynomials(self, q: np.ndarray) -> np.ndarray:
        x = np.clip((q - self.settings["middle"]) / self.settings["half"], -1, 1)
        return legendre.legvander(x, int(self.settings["degree"]))[:, 1:]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return laws from a parabola to one with three waves over the range that is often travelled.

        In a range that the joint rarely visited, a polynomial would be arbitrary.
        """
        low, high = scene.range_of(joints[0])
        if not low < high:
            return []
        degrees = [n for n in _DEGREES if n == _DEGREES[0] or n * _SECONDS <= scene.duration]
        return [{"middle": (low + high) / 2, "half": (high - low) / 2, "degree": n} for n in degrees]


class _PositionDrag(PositionFriction):
    """Viscous friction as a polynomial of the position; too rare to be a cause, and similar to one."""

    name = "position_drag"
    cause = False
    equation = "tau += v sum_k position_friction_k P_k((q - middle) / half), k = 1 .. degree"

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the speed times each polynomial."""
        P = self._polynomials(joint.q)
        return [joint.v * P[:, k] for k in range(P.shape[1])]


class PassiveJointFriction(Effect):
    """Viscous and Coulomb friction of all passive bearings, which share their coefficients."""

    name = "passive_joint_friction"
    cause = True
    equation = "tau += sum over passive bearings P' (viscous w + coulomb w / |w|), w = P v"
    reference = "Khalil & Dombre 2002, ch. 10"
    reveals = "motions in which the rods turn much, and motions in which all carts move together, in both directions"
    mistaken_for = ("viscous_asymmetry", "coulomb_asymmetry", "load_friction")
    # From instrument bearings to preloaded cardan joints
    plausible = (PlausibleRange("coulomb", 0.0, 10.0, "N m"), PlausibleRange("viscous", 0.0, 30.0, "N m/(rad/s)"))
    needs = ("passive",)
    nonnegative = True

    @property
    def parameters(self) -> Parameters:
        """The coefficients that all bearings share, at zero."""
        rows = (("viscous", "N m/(rad/s)"), ("coulomb", "N m"))
        return Parameters(Parameter(f"passive.{key}{self.label}", 0.0, u, 0.0, origin=self.name) for key, u in rows)

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together: bearings load every one of them."""
        return [scene.joints] if "passive" in scene.signals else []

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that there are no passive joints, if so."""
        return (
            None if "passive" in scene.signals else ("the robot has no loops and so no passive joints", NO_EXPERIMENT)
        )

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, 2)."""
        self._indices(motion)
        P = motion.signal("passive")
        w = np.einsum("nbxa,na->nbx", P, motion.v)
        speed = np.sqrt(np.sum(w**2, axis=2, keepdims=True))
        fading = np.max(np.abs(motion.sign), axis=1)[:, None, None]
        direction = np.divide(w, speed, out=np.zeros_like(w), where=speed > 0) * fading
        return np.stack([np.einsum("nbxa,nbx->na", P, x) for x in (w, direction)], axis=2)

    def describe(self, parameters: Parameters) -> str:
        """Return both coefficients in words."""
        viscous, coulomb = (format_amount(p) for p in parameters.select(self.parameters.names))
        return f"friction of {coulomb} and {viscous} in every joint without a motor"

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return each bearing's speed, converted to the joints' speed that causes it: `|w| / |P|`.

        The sign of a bearing with one axis may be uncertain. With more axes, the direction is uncertain if `|w|` is within the
        noise.
        """
        found = []
        joints = list(range(motion.v.shape[1]))
        for P in np.moveaxis(motion.signal("passive"), 1, 0):
            size = np.sqrt(np.sum(P**2, axis=(1, 2)))
            w = np.einsum("nxa,na->nx", P, motion.v)
            rate = np.sqrt(np.sum(w**2, axis=1)) if P[:, 1:].any() else w[:, 0]
            found.append((np.divide(rate, size, out=np.zeros_like(rate), where=size > 0), joints))
        return found
