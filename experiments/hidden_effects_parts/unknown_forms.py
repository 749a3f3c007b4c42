"""Forces that no cause of the contract explains; the right answer is a joint and variables, and no name."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Self

import numpy as np

from hidden_effects_parts.forms import Added, Form, Places, either, one
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig


class Scaled(NamedTuple):
    """One joint's motion at sizes about one, each (N,): position from -1 to 1, speed over the fast ones, acceleration."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


class Unknown(Added):
    """A force of joint j that depends on variables of j and perhaps of another joint k, about one in size."""

    robots = "any"
    other: ClassVar[bool] = False
    uses: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Self:
        """Draw the joints, a sign, and ranges to scale by."""
        j = one(rig, rng)
        k = int(rng.choice([x for x in range(len(rig.joints)) if x != j])) if cls.other else j
        middle = places.low[j] + places.span[j] * float(rng.uniform(0.3, 0.7))
        inner = {"sign": either(rng), "middle": middle, "half": places.span[j] / 2, "k": float(k)}
        inner |= {"fast_j": places.fast[j], "fast_k": places.fast[k], "turns": float(rng.uniform(0.7, 1.5))}
        inner |= {"middle_k": places.low[k] + places.span[k] / 2, "half_k": places.span[k] / 2}
        inner |= {"end": float(rng.uniform(30, 60))}
        return cls((j,), inner, 0.25 * rig.friction.coulomb[j])

    def unit(self, run: Recording) -> np.ndarray:
        """Return the force."""
        (j,), k, i = self.joints, int(self.inner["k"]), self.inner
        own = Scaled(
            (run.q[:, j] - i["middle"]) / i["half"], run.v[:, j] / i["fast_j"], run.a[:, j] / (4 * i["fast_j"])
        )
        other = Scaled((run.q[:, k] - i["middle_k"]) / i["half_k"], run.v[:, k] / i["fast_k"], run.a[:, k])
        return run.column(j, i["sign"] * self.law(own, other, run.t + run.number * (run.t[-1] + 1)))

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the force (N,) of joint j, from its own motion, the other joint's, and time [s]."""
        raise NotImplementedError

    @property
    def variables(self) -> frozenset[str]:
        """Return the law's variables with the joints put in."""
        names = {"j": self.joints[0], "k": int(self.inner["k"])}
        return frozenset(f"{x[0]}{names[x[1]]}" if len(x) > 1 else x for x in self.uses)


class PositionTimesSpeed(Unknown):
    """`q v`."""

    uses = ("qj", "vj")

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the product."""
        return own.q * own.v


class AccelerationSquared(Unknown):
    """`a |a|`."""

    uses = ("aj",)

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the square with its sign."""
        return own.a * np.abs(own.a)


class OtherSpeedSquared(Unknown):
    """`v_k^2` on joint j."""

    uses, other, robots = ("vk",), True, "several"

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the square."""
        return other.v**2


class OtherSign(Unknown):
    """`sin(q_j) sign(v_k)` on joint j."""

    uses, other, robots = ("qj", "vk"), True, "several"

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the wave with the other joint's sign."""
        return np.sin(np.pi * self.inner["turns"] * own.q) * np.sign(other.v)


class SpeedProduct(Unknown):
    """`v_j v_k` on joint j."""

    uses, other, robots = ("vj", "vk"), True, "several"

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the product."""
        return own.v * other.v


class PositionForce(Unknown):
    """A cable that pulls where it is bent: a bump of force along the way, whatever the direction."""

    uses = ("qj",)

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the bump."""
        return np.exp(-((own.q / 0.35) ** 2))


class OtherPositionDrag(Unknown):
    """`q_k v_j`: the other joint's position tightens this joint's seal."""

    uses, other, robots = ("qk", "vj"), True, "several"

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the product."""
        return other.q * own.v


class Settling(Unknown):
    """An offset that settles with time and no thermometer: `exp(-t / T)`."""

    uses = ("t",)

    def law(self, own: Scaled, other: Scaled, t: np.ndarray) -> np.ndarray:
        """Return the decay."""
        return np.exp(-t / self.inner["end"])


UNKNOWN_FORMS: tuple[type[Form], ...] = (
    PositionTimesSpeed, AccelerationSquared, OtherSpeedSquared, OtherSign, SpeedProduct, PositionForce, OtherPositionDrag,
    Settling,
)  # fmt: skip
"""Forms of this file."""
