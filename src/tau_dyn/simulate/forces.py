"""The effects' forces as a simulator needs them: for one sample, for both directions of motion at once, and fast.

At a state (q, v) an effect gives its force at `sign = -1` and at `sign = +1`; friction that holds a joint is between the two
(`plant.py` determines it). Effects are linear in their parameters and taken as affine in the acceleration, so their
contribution to the mass matrix is computed from unit accelerations. Three approximations: an effect whose own sign is not its
joint's (`reducer_coupling` turns with a sum of two speeds) is taken at the current speed and cannot stick; where an effect
pushes forwards (`sign = -1` above `sign = +1`) the sum is taken at the current direction; and an effect that depends on a
guide's load, which is not affine in the acceleration, takes the latest estimate of the acceleration. An effect that only
distorts the recording (`measured` effects) has no force here: `sensors.py` adds it to the log.

Some effects depend on more than the current state: on the room's temperature, by default

    T(t) = 20 + 20 (1 - exp(-t / 60 s)) degC,

since a machine takes an hour to warm up and a simulated minute must show it, and on the path of a bristle. Each
`thermal_drift` follows the temperature with its own lag, each `hysteresis` keeps its own state; both start in equilibrium.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tau_dyn.effects import (
    REDUNDANT,
    STATE,
    Bristle,
    DisplacementEffect,
    Effect,
    JointMotion,
    JointwiseEffect,
    Motion,
    RedundantArmature,
    acts_on_recording,
    follow_reversal,
)
from tau_dyn.exceptions import InputError
from tau_dyn.model import BY_STATE, COMPUTED, Model

COLD, RISE, WARMING_S = 20.0, 20.0, 60.0


def compute_warm_up(t: float | np.ndarray) -> np.ndarray:
    """Return the room's temperature [degC] at times [s] after the start."""
    return COLD + RISE * (1 - np.exp(-np.asarray(t, float) / WARMING_S))


@dataclass(frozen=True)
class EffectSurroundings:
    """Surroundings of the robot.

    Attributes:
        temperature: Temperature [degC], one or one a joint (na,), at a time [s] after the start.
        campaign: Number of the recording among several, for effects that need it.
    """

    temperature: Callable[[float], np.ndarray] = compute_warm_up
    campaign: float | None = None


class Memory:
    """Internal states of effects, advanced from sample to sample."""

    def __init__(self, effects: Iterable[Effect], na: int, surroundings: EffectSurroundings | None = None) -> None:
        """Start in equilibrium at time zero."""
        self.surroundings, self._na, self._t = surroundings or EffectSurroundings(), na, 0.0
        effects = tuple(effects)
        start = self._temperature()
        self._warm = {id(e): start for e in effects if "temperature" in e.needs}
        self._lag = {id(e): e.settings.get("lag", 0.0) for e in effects if "temperature" in e.needs}
        self._bristles = {id(e): (e, np.zeros(na)) for e in effects if isinstance(e, Bristle)}
        self._travel, self._heading = np.zeros(na), np.zeros(na)
        self._remembers = any("reversal" in e.needs or isinstance(e, DisplacementEffect) for e in effects)

    def signals(self, effect: Effect) -> dict[str, np.ndarray]:
        """Return the internal state of one effect, by signal, each (na,)."""
        found = {"reversal": self._travel} if "reversal" in effect.needs else {}
        if id(effect) in self._warm:
            found["temperature"] = self._warm[id(effect)]
        if id(effect) in self._bristles:
            found[STATE] = self._bristles[id(effect)][1]
        if "campaign" in effect.needs and self.surroundings.campaign is not None:
            found["campaign"] = np.full(self._na, self.surroundings.campaign)
        return found

    @property
    def heading(self) -> np.ndarray:
        """Direction of each joint's last motion (na,): -1, 1, or 0 before it moved at all."""
        return self._heading

    def advance(self, dq: np.ndarray, dt: float) -> None:
        """Move on by `dq` (na,) [m or rad] and `dt` [s]."""
        self._t += dt
        for key, lag in self._lag.items():
            keep = np.exp(-dt / lag) if lag > 0 else 0.0
            self._warm[key] = keep * self._warm[key] + (1 - keep) * self._temperature()
        for key, (effect, z) in self._bristles.items():
            self._bristles[key] = (effect, effect.followed(z, dq))
        if self._remembers:
            self._travel, self._heading = follow_reversal(self._travel, self._heading, dq)

    def _temperature(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.surroundings.temperature(self._t), float), (self._na,))


def repeat_signals(signals: Mapping[str, np.ndarray], n: int) -> dict[str, np.ndarray]:
    """Return signals (na,) of one sample repeated for `n` samples (n, na)."""
    return {key: np.tile(x, (n, 1)) for key, x in signals.items()}


_PROBES = 8  # states, by chance, at which an effect is asked whether it feels accelerations; sin(q) a is silent at zero
_REMEMBERED = frozenset({"temperature", "campaign", "reversal"})
_KNOWN = _REMEMBERED | BY_STATE


class SampledForces:
    """Forces of a model's effects at one sample; `memory` is advanced by whoever moves the robot."""

    def __init__(self, model: Model, surroundings: EffectSurroundings | None = None) -> None:
        """Look values up once; effects that act joint by joint are later evaluated for all joints in one call.

        Raises:
            InputError: An effect needs a signal that a simulation cannot provide.
        """
        model.robot.require_fixed_base("a simulation")
        self.model, self.joints, self.na = model, model.robot.actuated, model.robot.na
        self._rest, self._signs = np.zeros((2, self.na)), np.repeat([[-1.0], [1.0]], self.na, axis=1)
        effects = [effect for effect in model.effects if not acts_on_recording(effect)]
        self.memory = Memory(effects, self.na, surroundings)
        self._jointwise: list[_Jointwise] = []
        self._general: list[tuple[Effect, np.ndarray]] = []
        self._scaled: list[tuple[Effect, np.ndarray]] = []
        for effect in effects:
            self._place(effect, model.effect_parameters.select(effect.parameters.names).values)
        linear = [(e, x) for e, x in self._general if "load" not in e.needs]
        self._moves_mass = [(e, x) for e, x in linear if self._feels_acceleration(e, x)]

    @property
    def any(self) -> bool:
        """Whether there are effects at all."""
        return bool(self._jointwise or self._general or self._scaled)

    def bounds(self, q: np.ndarray, v: np.ndarray, a: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces (na,), (na,) [N or N m] at `sign` -1 and +1 and acceleration zero; the first is never larger.

        Args:
            q: Positions (na,).
            v: Velocities (na,).
            a: Accelerations (na,) as far as they are known, for the guides' loads.
        """
        both = np.zeros((2, self.na))
        for one in self._jointwise:
            both[:, one.index] += one.forces(q, v, self.memory)
        rest, signs = self._rest, self._signs
        for effect, values in self._general:
            felt = np.tile(a, (2, 1)) if "load" in effect.needs and a is not None else rest
            both += effect.columns(self._motion(effect, q, v, felt, signs)) @ values
        if self._scaled:
            whole = self.model.mechanism.inverse_dynamics(np.tile(q, (2, 1)), np.tile(v, (2, 1)), rest) + both
            for effect, values in self._scaled:
                both = both + effect.columns(self._motion(effect, q, v, rest, signs, whole)) @ values
        lower, upper = both
        pushing = lower > upper
        if pushing.any():
            lower[pushing] = upper[pushing] = np.where(v > 0, upper, lower)[pushing]
        return lower, upper

    def mass(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the effects' contribution to the mass matrix (na, na), or `None` if no effect depends on accelerations."""
        if not self._moves_mass and not self._scaled:
            return None
        added = np.zeros((self.na, self.na))
        for effect, values in self._moves_mass:
            added += self._per_acceleration(effect, values, q, v)
        if self._scaled:
            whole = (self.model.mechanism.mass_and_bias(q, v)[0] + added).T
            unit = np.eye(self.na)
            for effect, values in self._scaled:
                added = added + (effect.columns(self._motion(effect, q, v, unit, np.ones_like(unit), whole)) @ values).T
        return added

    def _place(self, effect: Effect, values: np.ndarray) -> None:
        """Sort an effect by the way its force is evaluated."""
        unknown = [name for name in effect.needs if name not in _KNOWN]
        if unknown:
            raise InputError(
                "unsupported", f"effect {effect.name} feels {unknown[0]}, which a simulation does not give"
            )
        if "campaign" in effect.needs and self.memory.surroundings.campaign is None:
            raise InputError(
                "unsupported",
                f"effect {effect.name} separates one recording from others, and a simulation is one recording: give this "
                "one its own coulomb and viscous friction instead",
            )
        if "force" in effect.needs:
            self._scaled.append((effect, values))
        elif isinstance(effect, JointwiseEffect) and _by_joint(effect) and not self._feels_acceleration(effect, values):
            index = np.array([self.joints.index(j) for j in effect.joints])
            self._jointwise.append(_Jointwise(effect, index, values))
        else:
            self._general.append((effect, values))

    def _per_acceleration(self, effect: Effect, values: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return `d force / d acceleration` (na, na) of one effect."""
        accelerations = np.vstack([np.zeros(self.na), np.eye(self.na)])
        force = effect.columns(self._motion(effect, q, v, accelerations, np.ones_like(accelerations))) @ values
        return (force[1:] - force[0]).T

    def _feels_acceleration(self, effect: Effect, values: np.ndarray) -> bool:
        if {"passive", "gravity_turn"} & set(effect.needs) or isinstance(effect, Bristle):
            return False  # feel speeds or places alone, and not every state by chance closes the loops
        if REDUNDANT in effect.needs:
            return isinstance(effect, RedundantArmature)
        states = np.random.default_rng(0).uniform(-1, 1, (_PROBES, 2, self.na))
        return any(np.any(self._per_acceleration(effect, values, q, v) != 0) for q, v in states)

    def _motion(
        self,
        effect: Effect,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray,
        force: np.ndarray | None = None,
    ) -> Motion:
        """Return `len(a)` samples at one position and speed, with the signals that an effect needs."""
        n = len(a)
        places, speeds = np.tile(q, (n, 1)), np.tile(v, (n, 1))
        signals = repeat_signals(self.memory.signals(effect), n)
        signals |= {
            name: COMPUTED[name](self.model.mechanism, places, speeds, a) for name in effect.needs if name in COMPUTED
        }
        return Motion.of(
            self.joints, places, speeds, a, sign, signals=signals | ({} if force is None else {"force": force})
        )


class _Jointwise:
    """An effect that acts on each of its joints separately, evaluated for all joints and both signs in one call."""

    def __init__(self, effect: JointwiseEffect, index: np.ndarray, values: np.ndarray) -> None:
        """Look up values; `index` (n,) are the effect's joints."""
        n = len(index)
        self.effect, self.index, self._twice = effect, index, np.tile(index, 2)
        self._values = np.tile(values.reshape(n, -1).T, 2)
        self._signs, self._rest = np.repeat((-1.0, 1.0), n), np.zeros(2 * n)

    def forces(self, q: np.ndarray, v: np.ndarray, memory: Memory) -> np.ndarray:
        """Return the forces (2, n) at signs -1 and 1."""
        twice = self._twice
        signals = {k: x[twice] for k, x in memory.signals(self.effect).items()} if self.effect.needs else {}
        joint = JointMotion(q[twice], v[twice], self._rest, self._signs, None, signals)
        force = sum(c * x for c, x in zip(self.effect.per_joint(joint), self._values, strict=True))
        return np.reshape(force, (2, len(self.index)))


def _by_joint(effect: JointwiseEffect) -> bool:
    """Return whether an effect depends on a joint's own motion and on its internal state alone."""
    plain = type(effect).columns is JointwiseEffect.columns and set(effect.needs) <= _REMEMBERED
    return plain or isinstance(effect, Bristle)
