"""What hides in a drive: ripple, late forces, wrong gains, gears that err or yield, motors that are shared."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.signal import bilinear, lfilter

from hidden_effects_parts.forms import Added, Form, Places, either, log_uniform, one
from hidden_effects_parts.recording import RATE_HZ, Recording
from hidden_effects_parts.robots import Rig


class Ripple(Added):
    """A force that repeats with position, with a second harmonic of up to half its size."""

    names = ("cyclic_ripple",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, a period of 15 to 150 mm (a turn over 8 to 80) and phases."""
        j = one(rig, rng)
        period = 2 * np.pi / log_uniform(rng, 8, 80) if rig.turns else log_uniform(rng, 0.015, 0.15)
        inner = {"period": period, "second": float(rng.uniform(0.1, 0.5)), "phase": float(rng.uniform(0, 6))}
        return cls((j,), inner | {"other": float(rng.uniform(0, 6))}, 0.3 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return both harmonics."""
        (j,), i = self.joints, self.inner
        turn = 2 * np.pi * run.q[:, j] / i["period"]
        return run.column(j, np.sin(turn + i["phase"]) + i["second"] * np.sin(2 * turn + i["other"]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the first harmonic's size and the period."""
        return {"ripple": amplitude, "period": self.inner["period"]}


class Delay(Form):
    """Forces of all joints that stand in the log `A` seconds late."""

    names = ("delay", "clock_offset")

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Take all joints."""
        return cls(tuple(range(len(rig.joints))), {}, 0.01)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with the forces of `A` seconds ago."""
        m, late = run.motion, run.t - amplitude
        q = CubicHermiteSpline(m.t, m.q, m.v)(late)
        v = CubicHermiteSpline(m.t, m.v, m.a)(late)
        a = CubicSpline(m.t, m.a)(late)
        return run.plus(run.rig.force(q, v, a) - run.rig.force(run.q, run.v, run.a))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the delay."""
        return {"delay": amplitude}


class DriveGain(Form):
    """One drive's force is reported too large or too small by the share A."""

    names = ("drive_gain",)
    robots = "l1"  # elsewhere its bodies' refit absorbs it

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and a direction."""
        return cls((one(rig, rng),), {"sign": either(rng)}, 0.3)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with one joint's forces scaled."""
        (j,) = self.joints
        return run.plus(run.column(j, self.inner["sign"] * amplitude * run.tau[:, j]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the share."""
        return {"gain_error": self.inner["sign"] * amplitude}


class TransmissionError(Form):
    """The encoder shows `q + A e(q)`, e periodic with a second harmonic; the robot moves as before."""

    names = ("transmission_error", "resolver_error")

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, a period of 30 to 250 mm (a turn over 5 to 40) and phases."""
        j = one(rig, rng)
        period = 2 * np.pi / log_uniform(rng, 5, 40) if rig.turns else log_uniform(rng, 0.03, 0.25)
        inner = {"period": period, "second": float(rng.uniform(0.02, 0.1)), "phase": float(rng.uniform(0, 6))}
        return cls((j,), inner, 2e-3 if rig.turns else 4e-4)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run as its encoder shows it."""
        (j,), w, c = self.joints, 2 * np.pi / self.inner["period"], self.inner["second"]
        q, v, a = run.q.copy(), run.v.copy(), run.a.copy()
        one_, two = w * q[:, j] + self.inner["phase"], 2 * w * q[:, j]
        slope = 1 + amplitude * w * (np.cos(one_) + 2 * c * np.cos(two))
        bend = -amplitude * w**2 * (np.sin(one_) + 4 * c * np.sin(two))
        a[:, j] = slope * a[:, j] + bend * v[:, j] ** 2
        v[:, j] = slope * v[:, j]
        q[:, j] += amplitude * (np.sin(one_) + c * np.sin(two))
        return replace(run, q=q, v=v, a=a)

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the first harmonic's size and the period."""
        return {"error": amplitude, "period": self.inner["period"]}


class ReducerCoupling(Added):
    """The last two hinges share a motor: inertia, viscous and Coulomb friction of the sum of their motions, on both."""

    names = ("reducer_coupling",)
    robots = "arm"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw the three parts' weights."""
        keys = ("inertia", "viscous", "coulomb")
        return cls((1, 2), dict(zip(keys, map(float, rng.dirichlet((1, 1, 1))), strict=True)), 8.0)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the motor's force on both joints."""
        v, a, i = run.v[:, 1] + run.v[:, 2], run.a[:, 1] + run.a[:, 2], self.inner
        force = i["inertia"] * a / 5 + i["viscous"] * v / 2 + i["coulomb"] * np.sign(v)
        return run.column(1, force) + run.column(2, force)

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the motor's inertia, viscous and Coulomb friction, the weightiest first."""
        i = self.inner
        parts = {"inertia": i["inertia"] / 5, "viscous": i["viscous"] / 2, "coulomb": i["coulomb"]}
        return {key: amplitude * parts[key] for key in sorted(parts, key=lambda key: -i[key])}


class Compliance(Form):
    """Between motor and load lies a spring of compliance A [m/N, rad/(N m)]; the load swings at its own frequency.

    The encoder sits on the motor. With the load's inertia m behind the spring and its swing `s`, `m (s'' + a) + d s' + k s = 0`,
    so the motor feels `m s''` more than the rigid robot would.
    """

    names = ("joint_compliance", "structural_compliance")
    motions = ("multisine", "multisine", "mixed")
    robots = "cart"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, the load's share of its inertia and its damping."""
        j = one(rig, rng)
        whole = float(rig.inertia(rig.robot.home[None])[0, j, j])
        inertia = whole * float(rng.uniform(0.3, 0.8))
        soft = 1 / (inertia * (2 * np.pi * 7.0) ** 2)  # softer ones would swing below 7 Hz
        return cls((j,), {"inertia": inertia, "damping": log_uniform(rng, 0.02, 0.08), "whole": whole}, soft)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with the swinging load's force."""
        (j,), m = self.joints, self.inner["inertia"]
        w = np.sqrt(1 / (amplitude * m))
        b, a = bilinear([-1.0, 0, 0], [1, 2 * self.inner["damping"] * w, w**2], RATE_HZ)
        swing = np.asarray(lfilter(b, a, run.motion.a[:, j]))
        return run.plus(run.column(j, m * swing[:: run.step]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the frequency [Hz] and the compliance that forces tell.

        Well below resonance the motor feels `m^2 A` times the jerk's change, so that is all that forces know: a log at the
        motor says as much of a softer spring with less behind it. With all inertia M behind it, as the cause has it, that is
        `A (m/M)^2`.
        """
        m, whole = self.inner["inertia"], self.inner["whole"]
        frequency = float(np.sqrt(1 / (amplitude * m)) / (2 * np.pi))
        return {"compliance": amplitude * (m / whole) ** 2, "frequency": frequency}


DRIVE_FORMS: tuple[type[Form], ...] = (Ripple, Delay, DriveGain, TransmissionError, ReducerCoupling, Compliance)
"""Forms of this file."""
