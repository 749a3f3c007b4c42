"""A motor's electric circuit, for logs whose force is its voltage: back-EMF, inductance, warm windings, a supply that sags.

    u = R i + k_e v + L di/dt,   tau = k_t i,   tau_log = (k_t / R_cold) u

Servos without a current sensor report voltage or pulse width. A column map converts it to a force, the torque of the cold motor
at rest (`tau_J: {column: volts, scale: 0.21}`), and keeps it as `voltage_J` or `pwm_J`. If force and voltage are proportional,
the force contains the circuit. Without the scale, masses and friction are known in units of `R / k_t`.

Back-EMF is indistinguishable from viscous friction, so no search finds it. A refit's `force` holds it, so the current's part of
the force is `tau = force - back_emf v`, with `back_emf = k_t k_e / R` a setting. Inductance leads by `L / R`, as a force logged
early does. Copper gains 0.39 % of resistance per kelvin, magnets lose 0.1 to 0.2 %: a warm motor needs more voltage for its
torque. A measured temperature gives that directly; otherwise windings warm with `i^2` over a first-order lag, as long as the
housing stays cool. A supply of resistance `R_s` loses `R_s i u / u_0` at pulse width `u / u_0`, to first order in the loss.
Reference: Hughes & Drury 2013, 3; Gautier & Briot 2014.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, format_amount, format_percent
from tau_dyn.effects.jointwise import JointwiseEffect, differentiate_columns
from tau_dyn.effects.motion import JointMotion, Scene
from tau_dyn.effects.varying_friction import filter_first_order
from tau_dyn.parameters import Parameter

VOLTAGE, PULSE_WIDTH = "voltage", "pwm"
"""Signals (N, na) of a log whose forces are proportional to them: voltages [V], shares of the supply."""
_WITH_CURRENT = "log the current and the voltage; identify then gives resistance, back-EMF and inductance"
_COLD = 20.0  # degC; a reference only scales the masses
_LAGS_S = (2.5, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0)
"""Time constants of windings tried [s]: a few seconds in a motor of 10 mm, a few minutes in an industrial one."""
_MAX_LAG_SHARE = 0.5
"""Largest time constant, as a share of the recording; a longer one is a drift in time."""
_BACK_EMF_SHARES = (0.0, 0.5, 1.0)
"""Back-EMF tried, as a share of the viscous friction that contains it."""


class CircuitEffect(JointwiseEffect):
    """Effect of a motor's circuit on a voltage that is logged as a force; the robot's motion does not change."""

    needs = (VOLTAGE,)
    signal: ClassVar[str] = VOLTAGE
    """Force contained in the log."""

    @property
    def measured(self) -> bool:
        """The voltage is recorded in place of the force."""
        return True


class BackEmf(CircuitEffect):
    """The voltage that a turning motor generates."""

    name = "back_emf"
    cause = True
    equation = "tau_log = tau + back_emf v"
    reference = "Hughes & Drury 2013, ch. 3"
    reveals = _WITH_CURRENT + "; or let the joint swing with its motor switched off, where friction alone brakes it"
    mistaken_for = ("viscous_curvature", "viscous_asymmetry")
    # It explains all of the viscous friction in voltages, or no part of it
    plausible = (PlausibleRange("back_emf", 0.0, 1.0, of="viscous"),)
    quantities = (("back_emf", "F/(V)"),)
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the speed."""
        return [joint.v]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the reason why no voltage distinguishes it from viscous friction."""
        twin = ("in a voltage it is a part of the viscous friction, which no motion under power divides", cls.reveals)
        return super().untestable(scene) or twin


class Inductance(CircuitEffect):
    """The voltage that changes a current."""

    name = "inductance"
    cause = True
    equation = "tau_log = tau + time_constant dtau/dt, time_constant = L / R"
    reference = "Hughes & Drury 2013, ch. 3"
    reveals = "forces that change within a few milliseconds; " + _WITH_CURRENT
    mistaken_for = ("delay", "clock_offset", "armature")
    equivalent = ("delay", "clock_offset")
    # From hobby servos to motors of some kilowatts
    plausible = (PlausibleRange("time_constant", 0.0, 0.03, "s"),)
    needs = (VOLTAGE, "force")
    quantities = (("time_constant", "s"),)
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force's rate; that of its back-EMF is an inertia, which the refit absorbs."""
        return [differentiate_columns(joint.signal("force"), joint.t)]


class ScaledCurrent(CircuitEffect):
    """A voltage that is larger by a factor than the current requires."""

    defaults: ClassVar[Mapping[str, float]] = {"back_emf": 0.0}
    setting_units: ClassVar[Mapping[str, str]] = {"back_emf": "F/(V)"}
    refined = ("back_emf",)
    nonnegative = True

    @abstractmethod
    def find_factor(self, current: np.ndarray, joint: JointMotion) -> np.ndarray:
        """Return the factor (N,) per unit of the amplitude, of the current's part of the force (N,)."""

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the factor times the current's part of the force."""
        current = joint.signal("force") - self.settings["back_emf"] * joint.v
        return [self.find_factor(current, joint) * current]

    @classmethod
    def list_back_emf(cls, scene: Scene, joint: str) -> list[float]:
        """Return the values of back-EMF to try [F/V], from zero to all of the viscous friction."""
        viscous = max(0.0, scene.scales.get(joint, {}).get("viscous", 0.0))
        return [share * viscous for share in (_BACK_EMF_SHARES if viscous else _BACK_EMF_SHARES[:1])]


class WindingHeat(ScaledCurrent):
    """Windings whose resistance rises as they warm."""

    name = "winding_heat"
    cause = True
    equation = "tau_log = tau (1 + resistance_rise h), lag dh/dt = (tau / rated)^2 - h, or h = T - 20 of a measured temperature"
    reference = "Hughes & Drury 2013, ch. 3; Gautier & Briot 2014"
    reveals = (
        "hard work and rest by turns, each for a minute, or temp_JOINT in the log; "
        "a warm motor must not be mistaken for a warm gear, so the same motion before and after"
    )
    mistaken_for = ("thermal_drift", "drive_gain", "friction_change", "load_friction")
    # Copper 0.39 % a kelvin and magnets up to 0.2; 100 K at a rated force that the largest one exceeds by up to three times
    plausible = (
        PlausibleRange("resistance_rise", 0.0, 4.0),
        PlausibleRange("resistance_per_kelvin", 0.0025, 0.007, "1/K"),
    )
    needs = (VOLTAGE, "force")
    quantities = ()
    defaults = {"back_emf": 0.0, "lag": 60.0, "rated": 1.0, "sensed": 0}
    setting_units = {"back_emf": "F/(V)", "lag": "s", "rated": "F"}
    positive = ("lag", "rated")
    refined = ("lag", "back_emf")
    open_ends = {"lag": "both"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Warm the windings of these joints; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["sensed"]:
            self.refined = ("back_emf",)

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One amplitude, named by the source of the temperature."""
        return (("resistance_per_kelvin", "1/K"),) if self.settings["sensed"] else (("resistance_rise", "1"),)

    def find_factor(self, current: np.ndarray, joint: JointMotion) -> np.ndarray:
        """Return the temperature above a cold motor's [K], or the lagged heating."""
        if self.settings["sensed"]:
            return joint.signal("temperature") - _COLD
        # cold at the start, as the filter starts in equilibrium at its first sample
        heating = (current / self.settings["rated"]) ** 2
        heating[:1] = 0.0
        return filter_first_order(heating, joint.t, self.settings["lag"])

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the rise and its time constant."""
        if self.settings["sensed"]:
            return f"a resistance that rises by {format_amount(values['resistance_per_kelvin'])}"
        rise, rated, lag = (
            format_percent(values["resistance_rise"]),
            self.setting("rated", joint),
            self.setting("lag", joint),
        )
        return f"windings whose resistance rises by {rise} under {rated}, with a time constant of {lag}"

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the setting for a measured temperature, if available, or time constants; each with some values of back-EMF."""
        rated = scene.scales.get(joints[0], {}).get("force", 0.0)
        if not rated > 0:
            return []
        known = "temperature" in scene.signals
        lags = [None] if known else [lag for lag in _LAGS_S if lag <= _MAX_LAG_SHARE * scene.duration]
        return [
            {"back_emf": b, "rated": rated, **({"sensed": 1} if lag is None else {"lag": lag})}
            for lag in lags
            for b in cls.list_back_emf(scene, joints[0])  # neighbours differ in it, as refinement requires
        ]


class SupplySag(ScaledCurrent):
    """A supply whose voltage falls as the motor draws current."""

    name = "supply_sag"
    cause = True
    equation = "tau_log = tau (1 + supply_sag (tau_log / peak)^2)"
    reference = "Hughes & Drury 2013, ch. 3"
    reveals = "small forces and large ones on one joint, or the supply's voltage in the log"
    mistaken_for = ("drive_gain", "load_friction", "quadratic_drag", "torque_speed_limit")
    # A long thin cable at the largest pulse width loses a third
    plausible = (PlausibleRange("supply_sag", 0.0, 0.5),)
    needs = (PULSE_WIDTH, "force")
    signal = PULSE_WIDTH
    quantities = (("supply_sag", "1"),)
    sentence = "a supply that loses {supply_sag} at the largest pulse width"
    defaults = {"back_emf": 0.0, "peak": 1.0}
    setting_units = {"back_emf": "F/(V)", "peak": "F"}
    positive = ("peak",)

    def find_factor(self, current: np.ndarray, joint: JointMotion) -> np.ndarray:
        """Return the square of the pulse width, as a share of the largest."""
        return (joint.signal("force") / self.settings["peak"]) ** 2

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return several values of back-EMF, at the joint's largest force."""
        peak = scene.scales.get(joints[0], {}).get("force", 0.0)
        return [{"back_emf": b, "peak": peak} for b in cls.list_back_emf(scene, joints[0])] if peak > 0 else []
