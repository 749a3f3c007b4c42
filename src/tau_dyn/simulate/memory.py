"""What effects feel that a single state does not tell: the room's temperature, and where a bristle was dragged.

    T(t) = 20 + 20 (1 - exp(-t / 60 s)) degC

by default: a machine takes an hour to warm up, and a simulated minute must show it. Each `thermal_drift` follows it with its own
lag, each `hysteresis` keeps its own state; both start in equilibrium.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tau_dyn.effects import STATE, Effect, Hysteresis

COLD, RISE, WARMING_S = 20.0, 20.0, 60.0


def compute_warm_up(t: float | np.ndarray) -> np.ndarray:
    """Return the room's temperature [degC] at times [s] after the start."""
    return COLD + RISE * (1 - np.exp(-np.asarray(t, float) / WARMING_S))


@dataclass(frozen=True)
class EffectSurroundings:
    """Where the robot stands.

    Attributes:
        temperature: Temperature [degC], one or one a joint (na,), at a time [s] after the start.
        campaign: Number of the recording among several, where effects ask for it.
    """

    temperature: Callable[[float], np.ndarray] = compute_warm_up
    campaign: float | None = None


class Memory:
    """Signals that effects remember, advanced from sample to sample."""

    def __init__(self, effects: Iterable[Effect], na: int, surroundings: EffectSurroundings | None = None) -> None:
        """Start in equilibrium at time zero."""
        self.surroundings, self._na, self._t = surroundings or EffectSurroundings(), na, 0.0
        effects = tuple(effects)
        start = self._temperature()
        self._warm = {id(e): start for e in effects if "temperature" in e.needs}
        self._lag = {id(e): e.settings.get("lag", 0.0) for e in effects if "temperature" in e.needs}
        self._bristles = {id(e): (e, np.zeros(na)) for e in effects if isinstance(e, Hysteresis)}
        self._travel, self._heading = np.zeros(na), np.zeros(na)

    def signals(self, effect: Effect) -> dict[str, np.ndarray]:
        """Return what one effect remembers, by signal, each (na,)."""
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
        sign = np.sign(dq)
        self._travel = np.abs(dq) + np.where(sign * self._heading < 0, 0.0, self._travel)
        self._heading = np.where(sign == 0, self._heading, sign)

    def _temperature(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.surroundings.temperature(self._t), float), (self._na,))


def repeat_signals(signals: Mapping[str, np.ndarray], n: int) -> dict[str, np.ndarray]:
    """Return signals (na,) of one sample repeated for `n` samples (n, na)."""
    return {key: np.tile(x, (n, 1)) for key, x in signals.items()}
