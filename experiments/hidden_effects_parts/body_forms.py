"""What hides in bodies that the robot file knows: a payload, a cart that is heavier than written.

The base model's refit absorbs both, so they show only against nominal masses that are trusted to 2 %.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from hidden_effects_parts.forms import Added, Form, Places, one
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig


class Heavier(Added):
    """A link's mass is larger by A [kg]; where the link is the plate or the last arm, that is a payload."""

    refit = False
    robots = "cart"

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw the link and 15 to 50 % of its mass."""
        link = cls.link_of(rig, rng)
        names = [p.name for p in rig.robot.parameters]
        share = float(rng.uniform(0.15, 0.5))
        inner = {"column": float(names.index(link)), "share": share}
        return cls(cls.joints_of(rig, link), inner, share * rig.nominal.parameters[link].value)

    @classmethod
    def link_of(cls, rig: Rig, rng: np.random.Generator) -> str:
        """Return the mass parameter that is off."""
        return f"{rig.joints[one(rig, rng)]}_link.mass" if rig.name == "l1" else "carriage_link.mass"

    @classmethod
    def joints_of(cls, rig: Rig, link: str) -> tuple[int, ...]:
        """Return the joints that feel it."""
        return (rig.joints.index(link.split("_link")[0]),) if rig.name == "l1" else (0,)

    def unit(self, run: Recording) -> np.ndarray:
        """Return the force of 1 kg more."""
        return run.rig.mechanism.regressor(run.q, run.v, run.a)[:, :, int(self.inner["column"])]

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return the additional mass."""
        return {"mass": amplitude}


class LinkMass(Heavier):
    """A cart is heavier than its file says."""

    names = ("link_mass",)
    robots = "l1"


class Payload(Heavier):
    """Something rides on the tool."""

    names = ("payload", "link_mass")
    robots = "l1"

    @classmethod
    def link_of(cls, rig: Rig, rng: np.random.Generator) -> str:
        """Return the plate's mass."""
        return f"{rig.robot.plate}.mass"

    @classmethod
    def joints_of(cls, rig: Rig, link: str) -> tuple[int, ...]:
        """Return all joints."""
        return tuple(range(len(rig.joints)))


BODY_FORMS: tuple[type[Form], ...] = (LinkMass, Payload)
"""Forms of this file."""
