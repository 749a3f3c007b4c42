"""Hidden friction: what Coulomb and viscous friction with coefficients of its own in each direction leaves out."""

from __future__ import annotations

from typing import Self

import numpy as np

from hidden_effects_parts.forms import Added, Form, Places, either, log_uniform, one
from hidden_effects_parts.gantry import load_across, rods_of
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig


class StribeckPower(Added):
    """`A sign(v) exp(-(|v| / vs)^p)` with a power p that is hardly ever the library's."""

    names = ("stribeck",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, p from {0.7, 1.5, 2, 2} and vs from 2.5 to 15 % of the fast speeds."""
        j = one(rig, rng)
        inner = {"speed": places.fast[j] * log_uniform(rng, 0.025, 0.15), "power": float(rng.choice((0.7, 1.5, 2, 2)))}
        return cls((j,), inner, 0.5 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the peak."""
        (j,) = self.joints
        v = run.v[:, j]
        return run.column(j, np.sign(v) * np.exp(-((np.abs(v) / self.inner["speed"]) ** self.inner["power"])))

    @property
    def variables(self) -> frozenset[str]:
        """Return the speed."""
        return frozenset(f"v{j}" for j in self.joints)


class QuadraticDrag(Added):
    """`A sign(v) |v|^n / V^n` with n from 1.7 to 2.3."""

    names = ("quadratic_drag",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and a power."""
        j = one(rig, rng)
        inner = {"power": float(rng.choice((1.7, 2.0, 2.3))), "speed": places.fast[j]}
        return cls((j,), inner, 0.6 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the drag, one at the fast speeds."""
        (j,) = self.joints
        v = run.v[:, j] / self.inner["speed"]
        return run.column(j, np.sign(v) * np.abs(v) ** self.inner["power"])

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the coefficient of `v |v|` where the power is two."""
        exact = self.inner["power"] == 2.0
        return {"quadratic_drag": amplitude / self.inner["speed"] ** 2} if exact else {}


class ViscousAsymmetry(Added):
    """`A |v| / V`: another viscous coefficient for each direction, under a symmetric base model."""

    names = ("viscous_asymmetry",)
    base = ("symmetric",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and which direction is worse."""
        j = one(rig, rng)
        inner = {"sign": either(rng), "speed": places.fast[j]}
        return cls((j,), inner, 0.5 * rig.friction.viscous[j] * places.fast[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the size of the speed."""
        (j,) = self.joints
        return run.column(j, self.inner["sign"] * np.abs(run.v[:, j]) / self.inner["speed"])

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return half the difference of the two coefficients."""
        return {"viscous_asymmetry": self.inner["sign"] * amplitude / self.inner["speed"]}


class Offset(Added):
    """A constant force, under a base model without one; asymmetric Coulomb friction is exactly the same."""

    names = ("torque_offset", "coulomb_asymmetry")
    base = ("plain",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and a sign."""
        j = one(rig, rng)
        return cls((j,), {"sign": either(rng)}, 0.5 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return one at speed, as Coulomb friction that is larger in one direction."""
        (j,) = self.joints
        return run.column(j, self.inner["sign"] * np.abs(np.sign(run.v[:, j])))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the force; the two names share it."""
        return {"offset": self.inner["sign"] * amplitude, "coulomb_asymmetry": self.inner["sign"] * amplitude}


class LoadFriction(Added):
    """`A load sign(v)`: the rod's force across the guideway rubs, or the torque that a gear transmits."""

    names = ("load_friction",)
    robots = "several"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint."""
        return cls((one(rig, rng),), {}, 0.5)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the load with the sign of the speed."""
        (j,) = self.joints
        if run.rig.name == "l1":
            load = load_across(run)[:, j]
        else:
            load = np.abs(run.rig.mechanism.inverse_dynamics(run.q, run.v, run.a)[:, j])
        return run.column(j, load * np.sign(run.v[:, j]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the coefficient of friction."""
        return {"load_friction": amplitude}


class PositionFriction(Added):
    """`A g(q) sign(v)`, g a bump somewhere or one and a half to three waves along the way."""

    names = ("position_friction",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, the kind of roughness and where it is."""
        j = one(rig, rng)
        middle = places.low[j] + places.span[j] * rng.uniform(0.25, 0.75)
        if rng.random() < 0.5:
            inner = {"bump": 1.0, "middle": middle, "width": places.span[j] * rng.uniform(0.06, 0.2)}
        else:
            inner = {"bump": 0.0, "middle": middle, "width": places.span[j] / rng.uniform(1.5, 3.0)}
        return cls((j,), inner, 0.5 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the roughness with the sign of the speed."""
        (j,) = self.joints
        x = (run.q[:, j] - self.inner["middle"]) / self.inner["width"]
        g = np.exp(-(x**2) / 2) if self.inner["bump"] else np.sin(2 * np.pi * x)
        return run.column(j, g * np.sign(run.v[:, j]))


class PassiveFriction(Added):
    """A moment in the rods' ball joints against their turning, mostly constant, by virtual work."""

    names = ("passive_joint_friction",)
    robots = "l1"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw one arm or all three."""
        arm = int(rng.integers(4))
        return cls((0, 1, 2), {"arm": float(arm), "viscous": float(rng.uniform(0, 0.3))}, 20.0)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the force of 1 N m in each of a rod's two ends."""
        rods = rods_of(run)
        speed = np.linalg.norm(rods.u, axis=2, keepdims=True) / rods.length[:, None]
        moment = 2 * (1 + self.inner["viscous"] * (speed / 0.5 - 0.5))  # rad/s
        if self.inner["arm"] < 3:
            moment = moment * (np.arange(3) == self.inner["arm"])[:, None]
        # rad/s; the direction of a rod that stands still means nothing
        direction = rods.u / rods.length[:, None] / np.maximum(speed, 1e-9)
        return np.einsum("nijk,nij->nk", rods.turn, moment * direction / rods.length[:, None])


class ThermalDrift(Added):
    """Friction that falls as a joint warms, later than its thermometer: `-A (T_oil - T_0) / 10 K (sign(v) + k v / V)`."""

    names = ("thermal_drift",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, how fast the motor warms and by how much the oil lags."""
        j = one(rig, rng)
        inner = {
            "tau": float(rng.uniform(40, 120)),
            "lag": float(rng.uniform(3, 20)),
            "rise": float(rng.uniform(8, 25)),
        }
        return cls(
            (j,), inner | {"viscous": float(rng.uniform(0, 1)), "speed": places.fast[j]}, rig.friction.coulomb[j]
        )

    def unit(self, run: Recording) -> np.ndarray:
        """Return the change of friction."""
        (j,) = self.joints
        rise, tau, lag = self.inner["rise"], self.inner["tau"], self.inner["lag"]
        t = run.t + run.number * (run.t[-1] + 1)
        late = 1 - (tau * np.exp(-t / tau) - lag * np.exp(-t / lag)) / (tau - lag)  # first order, twice
        v = run.v[:, j]
        return run.column(j, -rise / 10 * late * (np.sign(v) + self.inner["viscous"] * v / self.inner["speed"]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the Coulomb friction's change per kelvin."""
        return {"thermal_coulomb": -amplitude / 10}

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with the force; `warm` gives it thermometers."""
        return warm(super().act(run, amplitude), self.inner["tau"], self.inner["rise"])


class FrictionChange(Added):
    """Friction that is another in the second log: `A (sign(v) + k v / V)`."""

    names = ("friction_change",)
    runs = 2

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, a direction and how much of it is viscous."""
        j = one(rig, rng)
        inner = {"sign": either(rng), "viscous": float(rng.uniform(0, 0.6)), "speed": places.fast[j]}
        return cls((j,), inner, 0.3 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the change, nothing in the first log."""
        (j,) = self.joints
        v = run.v[:, j]
        size = self.inner["sign"] * (run.number > 0)
        return run.column(j, size * (np.sign(v) + self.inner["viscous"] * v / self.inner["speed"]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the Coulomb friction's change."""
        return {"coulomb_change": self.inner["sign"] * amplitude}


def warm(run: Recording, tau: float, rise: float) -> Recording:
    """Return the run with a thermometer of 0.1 K in each motor, which warms with a time constant [s] by a rise [K]."""
    t = run.t + run.number * (run.t[-1] + 1)
    names = run.rig.joints
    slower = 1 + 0.15 * np.arange(len(names))
    columns = {
        f"temp_{j}": np.round((22.0 + rise * (1 - np.exp(-t / (tau * s)))) * 10) / 10
        for j, s in zip(names, slower, strict=True)
    }
    return Recording(run.rig, run.motion, run.step, run.q, run.v, run.a, run.tau, run.number, {**run.extra, **columns})


FRICTION_FORMS: tuple[type[Form], ...] = (
    StribeckPower, QuadraticDrag, ViscousAsymmetry, Offset, LoadFriction, PositionFriction, PassiveFriction, ThermalDrift,
    FrictionChange,
)  # fmt: skip
"""Forms of this file."""
