"""A small robot that learns: two carts in a row behind slow, late drives, a sway that repeats and noise that does not."""

from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter

from tau_dyn.control.iterative import Reference, stack_controlled_actuators
from tau_dyn.modes import Actuator, StateSpace

DT = 0.004
N = 400


def motion(first: int = 100, last: int = 300, lead: int = 50) -> Reference:
    """Both carts there and back, 1 mm."""
    t = np.arange(N) * DT
    up = np.clip((t - 0.3) / 0.3, 0, 1)
    q = 1e-3 * np.column_stack([np.sin(np.pi * up) ** 2, up])
    return Reference(DT, q, np.column_stack([q, np.zeros(N)]), first, last, lead)


def actuators(a: float = 0.8, samples: int = 5) -> StateSpace:
    return stack_controlled_actuators([Actuator.from_discrete(1 - a, a, samples, DT)] * 2, DT)


@dataclass
class Carts:
    """The plant; what it shows of a trial is itself."""

    noise: float = 0.0
    a: float = 0.8
    samples: int = 5
    dt: float = DT
    runs: int = 0
    kinematic: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    q: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    tool: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def run(self, reference: np.ndarray, trial: int = 0) -> "Carts":
        """Return what the sensors show of references (N, 2)."""
        self.runs += 1
        late = np.vstack([np.zeros((self.samples, 2)), reference[: -self.samples]])
        moved = np.asarray(lfilter([1 - self.a], [1, -self.a], late, axis=0))
        sway = 2e-4 * np.sin(2 * np.pi * 1.5 * np.arange(len(late)) * DT)[:, None]
        rough = self.noise * np.random.default_rng(trial).standard_normal(moved.shape)
        q = moved + sway + rough
        tool = np.column_stack([q, np.zeros(len(q))])
        return Carts(self.noise, q=q, tool=tool, kinematic=tool, acceleration=np.zeros_like(tool))
