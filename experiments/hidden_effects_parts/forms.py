"""What a hidden effect is to this study: how it changes a run without noise, and which answer is right.

Every form says the names that are right as the first one (twins that no data can tell apart are both right), the joints and
variables it lives on, what the person's base model must be for it to hide, and an amplitude that is scaled until it is as
strong as wanted, up to `cap`, beyond which a person would have seen it without help.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from hidden_effects_parts.recording import Recording
from hidden_effects_parts.robots import Rig


@dataclass(frozen=True, eq=False)
class Places:
    """What a joint's range and speeds are in the runs at hand, from which inner parameters are drawn.

    Attributes:
        low: Smallest positions (na,) [m or rad].
        high: Largest positions (na,).
        fast: Speeds exceeded in 2 % of the samples (na,).
        hard: Accelerations exceeded in 2 % of the samples (na,).
    """

    low: np.ndarray
    high: np.ndarray
    fast: np.ndarray
    hard: np.ndarray

    @classmethod
    def of(cls, runs: Sequence[Recording]) -> Places:
        """Look at runs."""
        q, v, a = (np.concatenate([getattr(run, x) for run in runs]) for x in "qva")
        fast, hard = (np.quantile(np.abs(x), 0.98, axis=0) for x in (v, a))
        return cls(q.min(axis=0), q.max(axis=0), fast, hard)

    @cached_property
    def span(self) -> np.ndarray:
        """Ranges (na,)."""
        return self.high - self.low


@dataclass(frozen=True, eq=False)
class Form(ABC):
    """One effect with its inner parameters drawn.

    Attributes:
        joints: Indices of the joints it acts on.
        inner: Inner parameters by name, in SI units.
        cap: Largest amplitude that is still hidden.
        names: Right answers as the first name; empty where no cause of the contract explains it.
        robots: Which robots may have it, as `robots.DRAWS` calls them.
        base: Base models in which it hides.
        motions: Kinds of motion it is tried on; empty for any.
        runs: How many training logs it needs.
        refit: Whether something is left of it once the base model is refitted; if not, only a trusted nominal shows it.
        linear: Whether its force is its amplitude times a shape.
    """

    joints: tuple[int, ...]
    inner: Mapping[str, float]
    cap: float
    names: ClassVar[tuple[str, ...]] = ()
    robots: ClassVar[str] = "any"
    base: ClassVar[tuple[str, ...]] = ("asymmetric", "asymmetric", "symmetric")
    motions: ClassVar[tuple[str, ...]] = ()
    runs: ClassVar[int] = 1
    refit: ClassVar[bool] = True
    linear: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def draw(cls, rig: Rig, places: Places, rng: np.random.Generator) -> Form:
        """Return the effect on joints and with inner parameters drawn at random."""

    @abstractmethod
    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return what the run becomes."""

    @property
    def variables(self) -> frozenset[str]:
        """Variables it depends on: `q`, `v`, `a` with a joint's index, and `t`."""
        return frozenset()

    def truth(self, amplitude: float) -> dict[str, float]:
        """Return numbers that a finding's parameters can be compared with, by the name they end in."""
        return {}


class Added(Form):
    """An effect that adds `amplitude * unit(run)` to the force and changes nothing else."""

    linear = True

    @abstractmethod
    def unit(self, run: Recording) -> np.ndarray:
        """Return its force (N, na) at amplitude one."""

    def act(self, run: Recording, amplitude: float) -> Recording:
        """Return the run with the force."""
        return run.plus(amplitude * self.unit(run))


def one(rig: Rig, rng: np.random.Generator) -> int:
    """Return a joint by chance."""
    return int(rng.integers(len(rig.joints)))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def either(rng: np.random.Generator) -> float:
    """Return +1 or -1."""
    return float(rng.choice((-1.0, 1.0)))
