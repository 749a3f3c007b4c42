"""Hidden friction with a memory: bristles that bend before they slip, computed along the true motion at 1 kHz."""

from __future__ import annotations

from typing import Self

import numpy as np

from hidden_effects_parts.forms import Added, Form, Places, log_uniform, one
from hidden_effects_parts.recording import RATE_HZ, Recording
from hidden_effects_parts.robots import Rig

RADII = np.array([0.25, 0.5, 1.0, 2.0])
WEIGHTS = np.array([0.3, 0.3, 0.25, 0.15])


class Lugre(Form):
    """LuGre's bristles, stiff, with a static friction A above Coulomb: a Stribeck curve with power 2 and a little lag.

    z' = v - s0 |v| z / g(v),  force = s0 z,  g = Fc + A exp(-(v / vs)^2). Reference: Canudas de Wit et al. 1995.
    """

    names = ("stribeck",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint, vs from 2.5 to 15 % of the fast speeds, and bristles that slip below 0.5 % of them."""
        j = one(rig, rng)
        bend = (0.005 * places.fast[j]) ** 2 / (2 * places.hard[j]) / log_uniform(rng, 2, 10)
        inner = {"speed": places.fast[j] * log_uniform(rng, 0.025, 0.15), "bend": bend}
        return cls((j,), inner, 0.5 * rig.friction.coulomb[j])

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with bristles in place of Coulomb friction."""
        (j,) = self.joints
        friction, v = run.rig.friction, run.motion.v[:, j]
        coulomb = np.where(v > 0, friction.coulomb_pos[j], friction.coulomb_neg[j])
        g = coulomb + amplitude * np.exp(-((v / self.inner["speed"]) ** 2))
        stiffness = friction.coulomb[j] / self.inner["bend"]
        force = stiffness * bend_bristle(v, g / stiffness)
        hidden = force - coulomb * np.sign(v)
        return run.plus(run.column(j, hidden[:: run.step]))


class MaxwellSlip(Added):
    """Coulomb friction that builds up over millimetres after a reversal: four springs that slip one after another."""

    names = ("lugre", "hysteresis")

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and the way it takes, 0.1 to 1 % of the range."""
        j = one(rig, rng)
        return cls((j,), {"way": places.span[j] * log_uniform(rng, 1e-3, 1e-2)}, 0.8 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the springs' force less that of Coulomb friction."""
        (j,) = self.joints
        q, v = run.motion.q[:, j], run.motion.v[:, j]
        radii = self.inner["way"] * RADII
        force = _stops(q, radii) @ (WEIGHTS / radii)
        return run.column(j, (force - np.sign(v))[:: run.step])


def bend_bristle(v: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return a bristle's deflection (N,): it runs to where it slips, at the mean speed of each millisecond."""
    middle = (np.abs(v[1:]) + np.abs(v[:-1])) / 2
    decay = np.exp(-middle / reach[1:] / RATE_HZ).tolist()
    goal = (np.sign(v) * reach).tolist()
    out = [goal[0]]
    for d, g in zip(decay, goal[1:], strict=True):
        out.append(g + (out[-1] - g) * d)
    return np.array(out)


def _stops(q: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return springs' deflections (N, n) that slip at their radii; exact in each stretch of one direction."""
    turns = np.flatnonzero(np.diff(np.sign(np.diff(q))) != 0) + 1
    edges = np.concatenate([[0], turns, [len(q) - 1]])
    out, z = np.zeros((len(q), len(radii))), np.zeros(len(radii))
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        part = np.clip(z + (q[start : stop + 1] - q[start])[:, None], -radii, radii)
        out[start : stop + 1], z = part, part[-1]
    return out


SLIP_FORMS: tuple[type[Form], ...] = (Lugre, MaxwellSlip)
"""Forms of this file."""
