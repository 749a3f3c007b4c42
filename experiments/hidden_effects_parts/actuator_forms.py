"""What hides in actuators: lossy gears, bristles, compensated friction, cogging, voltages in the forces' place.

Each is written here in another form than the library's: a gear by its power, a bristle by LuGre's equation with
micro-damping, and compensation by a logistic switch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from hidden_effects_parts.drive_forms import Ripple
from hidden_effects_parts.forms import Added, Form, Places, log_uniform, one
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig
from hidden_effects_parts.slip_forms import bend_bristle

ORDERS = (1, 2, 4, 6, 12)
"""Periods of a motor's cogging in a turn: eccentricity, pole pairs, poles, slots."""
HIGHEST_HZ = 25.0
"""Frequency of the cogging at the fast speeds: about what `diagnose` leaves of forces with its low-pass."""


class LossyGear(Added):
    """A gear loses the share A of its load when it drives, and up to 60 % of A when it is driven."""

    names = ("directional_efficiency",)
    robots = "hinges"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and what is lost when driven, as a share of what is lost when driving."""
        return cls((one(rig, rng),), {"driven": float(rng.uniform(0, 0.6))}, 0.6)

    def unit(self, run: Recording) -> np.ndarray:
        """Return what the motor needs beyond the load, or is spared."""
        (j,) = self.joints
        load, v = run.rig.mechanism.inverse_dynamics(run.q, run.v, run.a)[:, j], run.v[:, j]
        power = load * v
        return run.column(j, np.where(power > 0, load, -self.inner["driven"] * load) * (power != 0))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return what is lost when driving."""
        return {"loss_driving": amplitude}


class SoftBristle(Added):
    """LuGre's bristle takes the part A of Coulomb friction and builds it up over 0.1 to 1 % of the range, with micro-damping."""

    names = ("lugre", "hysteresis")
    robots = "small"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, the way the bristle bends and its damping time."""
        j = one(rig, rng)
        inner = {"way": places.span[j] * log_uniform(rng, 1e-3, 1e-2), "damping_s": float(rng.uniform(0, 2e-3))}
        return cls((j,), inner, 0.8 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the bristle's force less that of Coulomb friction."""
        (j,), way = self.joints, self.inner["way"]
        v = run.motion.v[:, j]
        z = bend_bristle(v, np.full(len(v), way)) / way
        rate = v / way - np.abs(v) / way * z
        return run.column(j, (z + self.inner["damping_s"] * rate - np.sign(v))[:: run.step])


class Compensated(Added):
    """A drive's friction compensation takes A off above one speed, 4 to 15 % of the fast ones; below it all of it stands."""

    names = ("static_friction",)
    robots = "small"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and the speed."""
        j = one(rig, rng)
        return cls((j,), {"speed": places.fast[j] * log_uniform(rng, 0.04, 0.15)}, rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the friction that is not compensated."""
        (j,), speed = self.joints, self.inner["speed"]
        v = run.v[:, j]
        return run.column(j, np.sign(v) / (1 + np.exp(np.clip((np.abs(v) / speed - 1) / 0.05, -50, 50))))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the friction."""
        return {"static_friction": amplitude}


class MotorCogging(Ripple):
    """A ripple that repeats some whole number of times in each motor turn, with a second harmonic."""

    names = ("cogging",)
    robots = "hinges"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, an order whose period the joint passes slowly enough to be seen, and phases."""
        j = one(rig, rng)
        ratio = rig.nominal.gear_ratios[rig.joints[j]]
        seen = [k for k in ORDERS if places.fast[j] * ratio * k / (2 * np.pi) < HIGHEST_HZ]
        order = float(rng.choice(seen or ORDERS[:1]))
        inner = {"period": 2 * np.pi / (ratio * order), "second": float(rng.uniform(0, 0.5))}
        inner |= {"phase": float(rng.uniform(0, 6)), "other": float(rng.uniform(0, 6))}
        return cls((j,), inner, 0.3 * rig.friction.coulomb[j])

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the first harmonic's size and the period."""
        return {"cogging": amplitude, "period": self.inner["period"]}


class WarmWindings(Added):
    """Voltages are logged as forces, with back-EMF, and the resistance rises by A where the mean power heats for long."""

    names = ("winding_heat",)
    robots = "small"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, the windings' time constant and a back-EMF of up to twice the viscous friction."""
        j = one(rig, rng)
        back_emf = float(rng.uniform(0, 2)) * float(rig.friction.viscous[j])
        return cls((j,), {"lag": log_uniform(rng, 8, 30), "back_emf": back_emf}, 1.0)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with voltages."""
        (j,) = self.joints
        run = replace(run, drive="voltage").plus(run.column(j, self.inner["back_emf"] * run.v[:, j]))
        return super().act(run, amplitude)

    def unit(self, run: Recording) -> np.ndarray:
        """Return what a warm motor needs beyond a cold one."""
        (j,) = self.joints
        tau = run.rig.force(run.q, run.v, run.a)[:, j]
        power, dt = tau**2 / np.mean(tau**2), float(run.t[1] - run.t[0])
        keep, h = np.exp(-dt / self.inner["lag"]), 0.0
        warm = np.array([h := keep * h + (1 - keep) * p for p in power.tolist()])
        return run.column(j, warm * tau)


class SaggingSupply(Added):
    """Pulse widths are logged as forces, and the supply of one joint loses the share A of its voltage at the largest one."""

    names = ("supply_sag",)
    robots = "small"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint."""
        return cls((one(rig, rng),), {}, 0.4)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with pulse widths."""
        return super().act(replace(run, drive="pwm"), amplitude)

    def unit(self, run: Recording) -> np.ndarray:
        """Return what is lost of the force, by the square of the pulse width."""
        (j,) = self.joints
        tau = run.rig.force(run.q, run.v, run.a)[:, j]
        return run.column(j, tau * (tau / np.abs(tau).max()) ** 2)


ACTUATOR_FORMS: tuple[type[Form], ...] = (
    LossyGear,
    SoftBristle,
    Compensated,
    MotorCogging,
    WarmWindings,
    SaggingSupply,
)
"""Forms of this file."""
