"""What hides in sensors and in the reading of forces: zeros of joints, torque constants that fall, other drives that leak in."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from hidden_effects_parts.forms import Added, Form, Places, either, one
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig


class JointZero(Form):
    """The encoder of a joint shows `q + A`; the robot moves as before."""

    names = ("joint_zero",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and a direction."""
        return cls((one(rig, rng),), {"sign": either(rng)}, 0.5 if rig.turns else 0.05)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run as its encoder shows it."""
        q = run.q.copy()
        q[:, self.joints[0]] += self.inner["sign"] * amplitude
        return replace(run, q=q)

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the zero."""
        return {"joint_zero": self.inner["sign"] * amplitude}


class TorqueSaturation(Form):
    """A logged force that exceeds the true one by the share A at the largest force, with the power of the force drawn."""

    names = ("torque_saturation",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw a joint and the power, from 2.5 to 3.5."""
        return cls((one(rig, rng),), {"power": float(rng.uniform(2.5, 3.5))}, 0.4)

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with one joint's forces distorted."""
        (j,) = self.joints
        largest = np.abs(run.tau[:, j]).max()
        x = run.tau[:, j] / largest
        return run.plus(run.column(j, amplitude * largest * np.sign(x) * np.abs(x) ** self.inner["power"]))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the share at the largest force."""
        return {"torque_saturation": amplitude}


class TorqueCrosstalk(Added):
    """The share A of another joint's force leaks into a joint's force."""

    names = ("torque_crosstalk",)

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw two joints and a sign."""
        into = one(rig, rng)
        source = int(rng.choice([k for k in range(len(rig.joints)) if k != into] or [into]))
        return cls((into, source), {"sign": either(rng)}, 0.25)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the other joint's force."""
        into, source = self.joints
        return run.column(into, self.inner["sign"] * run.tau[:, source] * (into != source))

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the share."""
        return {"torque_crosstalk": self.inner["sign"] * amplitude}


SENSING_FORMS: tuple[type[Form], ...] = (JointZero, TorqueSaturation, TorqueCrosstalk)
"""Forms of this file."""
