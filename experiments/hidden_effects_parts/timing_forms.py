"""What hides in recordings, speed and mounting: a low-pass, a long delay, friction that levels off, a base that leans.

Each is written here once more, in another form than the library's: the low-pass by its transfer function on the true motion at
1 kHz, friction as an arctan or a power of the speed, the tilt by Pinocchio's gravity torque under gravity turned by a matrix.
"""

from __future__ import annotations

from typing import Self

import numpy as np
import pinocchio as pin

from hidden_effects_parts.drive_forms import Delay
from hidden_effects_parts.forms import Added, Form, Places, log_uniform, one
from hidden_effects_parts.recording import RATE_HZ, Recording
from hidden_effects_parts.robots import Rig

_PAD = 5000
"""Samples of rest before and after, so that the transform's end does not reach its beginning."""


class Lag(Form):
    """Forces of all joints behind a first-order low-pass of time constant A; one below 3 ms is as well a delay."""

    names = ("drive_lag", "delay", "clock_offset")

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Take all joints."""
        return cls(tuple(range(len(rig.joints))), {}, 0.03)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with low-passed forces."""
        m = run.motion
        force = run.rig.force(m.q, m.v, m.a)
        padded = np.concatenate([np.repeat(force[:1], _PAD, axis=0), force, np.repeat(force[-1:], _PAD, axis=0)])
        w = 2 * np.pi * np.fft.rfftfreq(len(padded), 1 / RATE_HZ)
        late = np.fft.irfft(np.fft.rfft(padded, axis=0) / (1 + 1j * w * amplitude)[:, None], len(padded), axis=0)
        return run.plus((late[_PAD : len(force) + _PAD] - force)[:: run.step])

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the time constant, which a delay of the same length imitates."""
        return {"time_constant": amplitude, "delay": amplitude}


class LongDelay(Delay):
    """Forces of all joints up to 100 ms late; drawn with a strength of 1e3 or more, and only where it is asked for."""

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Take all joints."""
        return cls(tuple(range(len(rig.joints))), {}, 0.1)


class LevellingFriction(Added):
    """`A arctan(v / vk)` or `A sign(v) |v / V|^p` with p of a third to two thirds: viscous friction that levels off."""

    names = ("viscous_curvature",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and a law; the knee at 5 to 30 % of the fast speeds."""
        j = one(rig, rng)
        power = float(rng.choice((0.0, 0.0, 1 / 3, 0.5, 2 / 3)))
        inner = {"power": power, "knee": places.fast[j] * log_uniform(rng, 0.05, 0.3), "speed": places.fast[j]}
        return cls((j,), inner, 1.5 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the friction."""
        (j,) = self.joints
        v, power = run.v[:, j], self.inner["power"]
        if power:
            return run.column(j, np.sign(v) * (np.abs(v) / self.inner["speed"]) ** power)
        return run.column(j, np.arctan(v / self.inner["knee"]))

    @property
    def variables(self) -> frozenset[str]:
        """Return the speed."""
        return frozenset(f"v{j}" for j in self.joints)


class Tilt(Added):
    """Gravity leans by A [rad] towards a direction of the floor."""

    names = ("gravity_direction",)
    robots = "arm"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw the direction of the axis about which it leans."""
        return cls(tuple(range(len(rig.joints))), {"towards": float(rng.uniform(0, 2 * np.pi))}, 0.2)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the torque of a lean by 1 rad, from a hundredth of it."""
        axis = np.array([np.cos(self.inner["towards"]), np.sin(self.inner["towards"]), 0.0])
        plain = run.rig.robot.model_with(run.rig.robot.parameters)
        leaning = pin.Model(plain)
        leaning.gravity.linear = pin.exp3(0.01 * axis) @ plain.gravity.linear
        both = [(model, model.createData()) for model in (plain, leaning)]
        still, leant = (np.array([pin.computeGeneralizedGravity(m, d, q) for q in run.q]) for m, d in both)
        return (leant - still) / 0.01

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the larger of both turns."""
        x, y = amplitude * np.cos(self.inner["towards"]), amplitude * np.sin(self.inner["towards"])
        return {"tilt_x": float(x)} if abs(x) > abs(y) else {"tilt_y": float(y)}


TIMING_FORMS: tuple[type[Form], ...] = (Lag, LevellingFriction, Tilt)
"""Forms of this file that are drawn."""
