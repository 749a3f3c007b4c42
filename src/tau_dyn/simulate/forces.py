"""The effects' forces as a simulator needs them: for one sample, for both directions of motion at once, and fast.

At a state (q, v) an effect gives its force at `sign = -1` and at `sign = +1`; friction that stops a motion lies between
(`slip.py` chooses). Effects are linear in their parameters and taken as affine in the acceleration, so what they add to the
mass matrix is found by asking for unit accelerations. Two approximations: an effect whose own sign is not its joint's
(`reducer_coupling` turns with a sum of two speeds) is taken at the current speed and cannot stick, and where an effect pushes
forwards (`sign = -1` above `sign = +1`) the sum is taken at the current direction.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects import Effect, JointwiseEffect, Motion
from tau_dyn.model import Model

_PROBES = 8  # states, by chance, at which an effect is asked whether it feels accelerations; sin(q) a is silent at zero


class SampledForces:
    """Forces of a model's effects at one sample."""

    def __init__(self, model: Model) -> None:
        """Look values up once; effects that act joint by joint are later asked for all joints in one call."""
        self.joints, self.na = model.robot.actuated, model.robot.na
        self._jointwise: list[tuple[JointwiseEffect, np.ndarray, np.ndarray]] = []
        self._general: list[tuple[Effect, np.ndarray]] = []
        for effect in model.effects:
            values = model.effect_parameters.select(effect.parameters.names).values
            if isinstance(effect, JointwiseEffect) and type(effect).columns is JointwiseEffect.columns:
                index = np.array([self.joints.index(j) for j in effect.joints])
                by_quantity = values.reshape(len(index), -1).T
                self._jointwise.append((effect, index, np.tile(by_quantity, 2)))
            else:
                self._general.append((effect, values))
        self._moves_mass = [(e, x) for e, x in self._general if self._feels_acceleration(e, x)]

    @property
    def any(self) -> bool:
        """Whether there are effects at all."""
        return bool(self._jointwise or self._general)

    def bounds(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces (na,), (na,) [N or N m] at `sign` -1 and +1 and acceleration zero; the first is never larger."""
        both = np.zeros((2, self.na))
        for effect, index, values in self._jointwise:
            n = len(index)
            speeds, signs = np.tile(v[index], 2), np.repeat((-1.0, 1.0), n)
            force = sum(c * x for c, x in zip(effect.per_joint(speeds, signs), values, strict=True))
            both[:, index] += np.reshape(force, (2, n))
        if self._general:
            motion = self._motion(q, v, np.zeros((2, self.na)), np.repeat([[-1.0], [1.0]], self.na, axis=1))
            for effect, values in self._general:
                both += effect.columns(motion) @ values
        lower, upper = both
        pushing = lower > upper
        if pushing.any():
            lower[pushing] = upper[pushing] = np.where(v > 0, upper, lower)[pushing]
        return lower, upper

    def mass(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return what the effects add to the mass matrix (na, na), or None where none of them feels accelerations."""
        if not self._moves_mass:
            return None
        added = np.zeros((self.na, self.na))
        for effect, values in self._moves_mass:
            added += self._per_acceleration(effect, values, q, v)
        return added

    def _per_acceleration(self, effect: Effect, values: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return `d force / d acceleration` (na, na) of one effect."""
        accelerations = np.vstack([np.zeros(self.na), np.eye(self.na)])
        force = effect.columns(self._motion(q, v, accelerations, np.ones_like(accelerations))) @ values
        return (force[1:] - force[0]).T

    def _feels_acceleration(self, effect: Effect, values: np.ndarray) -> bool:
        states = np.random.default_rng(0).uniform(-1, 1, (_PROBES, 2, self.na))
        return any(np.any(self._per_acceleration(effect, values, q, v) != 0) for q, v in states)

    def _motion(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, sign: np.ndarray) -> Motion:
        n = len(a)
        return Motion(self.joints, np.tile(q, (n, 1)), np.tile(v, (n, 1)), a, sign)
